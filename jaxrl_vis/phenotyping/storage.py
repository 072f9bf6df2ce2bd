"""Files of OpenCV's FileStorage and of ROS, YAML, XML or JSON, as plain dictionaries, lists, numbers and texts.

OpenCV's own reader is not asked: it recurses as deep as a file says and writes where it must not, so that a file can end the
program without a word. These files need no more of YAML than tables, lists and numbers: no tags, no references.
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
    """Parse a file of OpenCV's storage: numbers are float, quoted values are text. A matrix is a table with ``data``.

    Raises:
        ValueError: It is neither YAML nor XML nor JSON as OpenCV and ROS write them.
    """
    begin = text.lstrip()
    if begin.startswith("<"):
        return _node(parse_xml(begin))
    if begin.startswith("{"):
        try:
            return _floats(parse_json(begin))
        except ValueError:
            pass  # a table of YAML
    return _yaml(begin.partition("\n")[2] if begin.startswith("%YAML") else text)


def _floats(value: Any) -> Any:
    """Numbers as YAML gives them."""
    if isinstance(value, dict):
        return {name: _floats(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_floats(part) for part in value]
    return _scalar(str(value)) if isinstance(value, int) and not isinstance(value, bool) else value


def _scalar(text: str) -> float | str | None:
    """A number, a text, or nothing, by how it is written."""
    if _NUMBER.fullmatch(text):
        return float(text)
    return _SPECIAL.get(text.lower(), text or None)


def _yaml(text: str) -> Any:
    """The first document of a file of YAML."""
    root: list[Any] = []
    open_nodes: list[Any] = [root]
    keys: list[str | None] = [None]

    def put(value: Any) -> None:
        place = open_nodes[-1]
        if isinstance(place, list):
            place.append(value)
        elif keys[-1] is None:
            if not isinstance(value, (str, float)):
                raise ValueError("a name that is no word")
            keys[-1] = str(value)
        else:
            place[keys[-1]], keys[-1] = value, None

    try:
        # Event by event: PyYAML's own way from there to values recurses.
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
    """A node of OpenCV's XML: a table, a list if its parts have no names, or what its text says."""
    if len(element):
        if all(part.tag == "_" for part in element):
            return [_node(part) for part in element]
        return {str(part.tag): _node(part) for part in element}
    text = (element.text or "").strip()
    if len(text) > 1 and text[0] == text[-1] == '"':
        return text[1:-1]
    values = [_scalar(word) for word in text.split()]
    return values if len(values) > 1 else values[0] if values else None
