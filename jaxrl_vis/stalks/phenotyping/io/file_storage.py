"""Parser of OpenCV FileStorage and ROS files (YAML, XML or JSON) to plain dictionaries, lists, numbers and strings.

OpenCV's own parser is not used: it recurses without limit and writes out of bounds, so that a malformed file can crash the
process. Of YAML, only mappings, sequences and scalars are supported: tags are ignored, and aliases are errors.
"""

import math
import re
from typing import Any
from xml.etree.ElementTree import Element

import yaml

from jaxrl_vis_envs.documents import MAX_DEPTH, parse_json, parse_xml

_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_SPECIAL = {".nan": math.nan, ".inf": math.inf, "+.inf": math.inf, "-.inf": -math.inf}


def parse_storage(text: str) -> Any:
    """Parse the text of a FileStorage: numbers become float, quoted values str, and a matrix a dictionary with ``data``.

    Raises:
        ValueError: The text is neither YAML nor XML nor JSON as OpenCV and ROS write them.
    """
    begin = text.lstrip()
    if begin.startswith("<"):
        return _node(parse_xml(begin))
    if begin.startswith("{"):
        try:
            return _floats(parse_json(begin))
        except ValueError:
            pass  # may be a YAML flow mapping
    return _parse_yaml(begin.partition("\n")[2] if begin.startswith("%YAML") else text)


def _floats(value: Any) -> Any:
    """Convert the integers of parsed JSON to float, as `_parse_yaml` does."""
    if isinstance(value, dict):
        return {name: _floats(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_floats(part) for part in value]
    return _scalar(str(value)) if isinstance(value, int) and not isinstance(value, bool) else value


def _scalar(text: str) -> float | str | None:
    """Convert an unquoted scalar to float, or else to str; None if it is empty."""
    if _NUMBER.fullmatch(text):
        return float(text)
    return _SPECIAL.get(text.lower(), text or None)


def _parse_yaml(text: str) -> Any:
    """Parse the first document of a YAML text.

    Raises:
        ValueError: The text is not YAML, is nested too deeply, or holds aliases.
    """
    root: list[Any] = []
    open_nodes: list[Any] = [root]
    keys: list[str | None] = [None]

    def put(value: Any) -> None:
        place = open_nodes[-1]
        if isinstance(place, list):
            place.append(value)
        elif keys[-1] is None:
            if not isinstance(value, (str, float)):
                raise ValueError("a name that is not a word")
            keys[-1] = str(value)
        else:
            place[keys[-1]], keys[-1] = value, None

    try:
        # Built from events, since PyYAML's own constructor recurses.
        for event in yaml.parse(text, Loader=_LOADER):
            if isinstance(event, yaml.DocumentEndEvent):
                break
            if isinstance(event, yaml.AliasEvent):
                raise ValueError("a reference to another place")
            if isinstance(event, yaml.ScalarEvent):
                put(_scalar(event.value) if not event.style else event.value)
            elif isinstance(event, yaml.CollectionStartEvent):
                value: Any = {} if isinstance(event, yaml.MappingStartEvent) else []
                put(value)
                open_nodes.append(value)
                keys.append(None)
                if len(open_nodes) > MAX_DEPTH:
                    raise ValueError(f"nested more than {MAX_DEPTH} levels deep")
            elif isinstance(event, yaml.CollectionEndEvent):
                open_nodes.pop()
                keys.pop()
    except (yaml.YAMLError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        raise ValueError("no YAML" if mark is None else f"line {mark.line + 1}: {getattr(error, 'problem', '')}") from error
    return root[0] if root else {}


def _node(element: Element) -> Any:
    """Convert a node of OpenCV's XML to a dictionary, a list if its children are unnamed, or the value(s) of its text."""
    if len(element):
        if all(part.tag == "_" for part in element):
            return [_node(part) for part in element]
        return {str(part.tag): _node(part) for part in element}
    text = (element.text or "").strip()
    if len(text) > 1 and text[0] == text[-1] == '"':
        return text[1:-1]
    values = [_scalar(word) for word in text.split()]
    return values if len(values) > 1 else values[0] if values else None
