"""Parser of tables from spreadsheets, robots and field programs, separated by commas, semicolons, tabs or spaces."""

import csv
import io
import re
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.spreadsheets import unescape_cell
from jaxrl_vis_envs.documents import read_bytes


def read_table_text(path: Path, max_bytes: int) -> str:
    """Read the text of a table.

    Raises:
        RequestError: The file cannot be read, is larger than ``max_bytes``, or is neither UTF-8 nor UTF-16.
    """
    try:
        data = read_bytes(path, max_bytes)
        # Spreadsheets write a byte order mark before the name of the first column.
        return data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except OSError as error:
        raise RequestError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise RequestError(f"{path} is not a table: save it as CSV in UTF-8 (is not UTF-8 text)") from error
    except ValueError as error:
        raise RequestError(f"{path} is not a table: save it as CSV in UTF-8 ({error})") from error


def split_cells(path: Path, text: str) -> tuple[list[str], list[tuple[int, list[str]]], bool]:
    """Split a table into cells.

    Lines that begin with ``#`` before the table are skipped, except one that names the columns.

    Args:
        path: The file, for messages.
        text: Its contents.

    Returns:
        Names of the columns; the non-empty rows with their line numbers; and a boolean, True if commas in numbers are decimal
        separators.

    Raises:
        RequestError: The text is not a table.
    """
    lines = text.splitlines()
    first = next((index for index, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), len(lines))
    comment = next((line.lstrip("# ") for line in reversed(lines[:first]) if line.strip(" #")), "")
    head = lines[first] if first < len(lines) else ""
    if re.match(r"\s*[-+.\d]", head) and comment:
        first, head = first - 1, comment  # the columns are named in a comment, as in TUM trajectories
    counts = {mark: head.count(mark) for mark in ("\t", ";", ",")}
    mark = max(counts, key=lambda mark: counts[mark]) if any(counts.values()) else None
    if mark is None and len(head.split()) > 1 and "(" not in head and "[" not in head:
        mark = " "
    body = "\n".join([head, *lines[first + 1 :]])
    try:
        reader = csv.reader(io.StringIO(body, newline=""), delimiter=mark or ",", skipinitialspace=True)
        columns = [unescape_cell(name.strip()).strip() for name in next(reader, [])]
        rows = [(first + reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise RequestError(f"{path} is not a table: save it as CSV in UTF-8 ({error})") from error
    return columns, rows, mark in ("\t", ";", " ")
