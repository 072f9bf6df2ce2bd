"""What people look at: curves, videos, the gallery of tasks, the 3-D viewer."""

import logging

_OF_ITS_FOLDER = ("mkdir -p failed", "is not a writable directory", "created a temporary cache directory")


def _is_news(record: logging.LogRecord) -> bool:
    return not any(words in str(record.msg) for words in _OF_ITS_FOLDER)


# Where the home cannot be written, Matplotlib keeps its fonts in a temporary folder, and says so twice: nothing here changes.
logging.getLogger("matplotlib").addFilter(_is_news)
