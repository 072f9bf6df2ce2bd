"""Visual output: curves, videos, the gallery of tasks, the 3-D viewer."""

import logging

_FOLDER_MESSAGES = ("mkdir -p failed", "is not a writable directory", "created a temporary cache directory")


def _is_relevant(record: logging.LogRecord) -> bool:
    return not any(words in str(record.msg) for words in _FOLDER_MESSAGES)


# If the home folder is not writable, Matplotlib reports twice that it caches fonts in a temporary folder, which is irrelevant.
logging.getLogger("matplotlib").addFilter(_is_relevant)
