"""Hypothesis strategies that corrupt valid files: their trees, texts and bytes.

A document whose tree is corrupted is still valid JSON, YAML, TOML or XML, so that its reader gets past the parser to the checks
of names, types and numbers; one that is corrupted as text mostly does not.
"""

import copy
import json
import math
import struct
import zlib
from typing import Any
from xml.etree import ElementTree

import yaml
from hypothesis import strategies as st

DEEP = 300
"""Nesting depth of deep values in trees; texts get up to 3000 brackets."""
NUMBERS = (0, -1, 1, 2, 7, 0.5, -0.0, 1.5, 1e-320, 1e7, 1e9, -1e9, 1e18, 2**31, 2**63, 10**30, 1e308, -1e308, 10**400)
WORDS = (
    "",
    "x",
    "0",
    "-1",
    "1e400",
    "nan",
    "stalk",
    "é",
    "\0",
    "a\nb",
    "\ud800",
    "=1+1",
    "../../x",
    "/etc/passwd",
    "C:\\x",
    "x" * 300,
)
CONSTANTS = (None, True, False, math.nan, math.inf, -math.inf)


def _deep(kind: type) -> Any:
    value: Any = 0
    for _ in range(DEEP):
        value = [value] if kind is list else {"a": value}
    return value


def leaves() -> st.SearchStrategy[Any]:
    """Return a strategy for scalars that may stand in a file instead of the intended ones."""
    return st.one_of(
        st.sampled_from(NUMBERS),
        st.integers(-(2**70), 2**70),
        st.floats(),
        st.sampled_from(CONSTANTS),
        st.sampled_from(WORDS),
        st.text(max_size=8),
    )


def values() -> st.SearchStrategy[Any]:
    """Return a strategy for `leaves`, lists and tables, some of them deep or long."""
    containers = [[], {}, [[]], [{}], {"": None}, [0] * 12, ["1"] * 4, [0] * 5000, _deep(list), _deep(dict)]
    return st.one_of(leaves(), leaves(), st.sampled_from(containers), st.lists(leaves(), max_size=13))


def _places(tree: Any, path: tuple = ()) -> list[tuple]:
    """Return the paths (keys and indices from the root) of a tree's nodes; of a list's items, only of the first 40."""
    found = [path] if path else []
    if isinstance(tree, dict):
        for key, value in tree.items():
            found += _places(value, (*path, key))
    elif isinstance(tree, list):
        for key, value in enumerate(tree[:40]):
            found += _places(value, (*path, key))
    return found


def _at(tree: Any, path: tuple) -> Any:
    for key in path:
        tree = tree[key]
    return tree


@st.composite
def trees(draw: st.DrawFn, valid: Any, most: int = 3) -> Any:
    """Draw a valid tree with 0 to ``most`` nodes replaced, scaled, removed, renamed, duplicated or copied over others."""
    tree = copy.deepcopy(valid)
    for _ in range(draw(st.integers(0, most))):
        places = _places(tree)
        if not places:
            return draw(values())
        path = draw(st.sampled_from(places))
        parent, key = _at(tree, path[:-1]), path[-1]
        action = draw(st.sampled_from(("replace", "scale", "replace", "drop", "rename", "double", "exchange")))
        if action == "replace":
            parent[key] = draw(values())
        elif action == "scale" and isinstance(parent[key], (int, float)) and not isinstance(parent[key], bool):
            parent[key] = parent[key] * draw(st.sampled_from((0, -1, 0.5, 2, 1000, 1e6)))
        elif action == "drop":
            del parent[key]
        elif action == "rename" and isinstance(parent, dict):
            parent[draw(st.sampled_from((*WORDS, key.upper() if isinstance(key, str) else "x")))] = parent.pop(key)
        elif action == "double" and isinstance(parent, list):
            parent.insert(key, copy.deepcopy(parent[key]))
        elif action == "exchange":
            parent[key] = copy.deepcopy(_at(tree, draw(st.sampled_from(places))))
    return tree


def json_text(tree: Any) -> str:
    """Return a tree as JSON, including lone surrogates and infinities."""
    return json.dumps(tree)


def yaml_text(tree: Any) -> str:
    """Return a tree as YAML as written by PyYAML, with innermost collections in flow style (brackets)."""
    return yaml.safe_dump(tree, default_flow_style=None, allow_unicode=True)


def toml_text(tree: Any, name: str = "") -> str:
    """Return a table of tables as TOML; values that it cannot express are left out."""
    lines = [f"[{name}]"] if name else []
    tables = []
    for key, value in tree.items() if isinstance(tree, dict) else ():
        quoted = json.dumps(str(key))
        if isinstance(value, dict) and value and not name:
            tables.append(toml_text(value, quoted))
        else:
            written = _toml_value(value)
            lines += [f"{quoted} = {written}"] if written is not None else []
    return "\n".join([*lines, *tables]) + "\n"


def _toml_value(value: Any) -> str | None:
    if value is None:
        return None
    if isinstance(value, dict):
        parts = {key: _toml_value(part) for key, part in value.items()}
        return "{" + ", ".join(f"{json.dumps(str(key))} = {part}" for key, part in parts.items() if part is not None) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(filter(None, map(_toml_value, value))) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value).lower()
    return json.dumps(value, ensure_ascii=False)


def xml_text(tree: Any, name: str) -> str:
    """Return a tree as XML: tables become nested nodes, lists repeated nodes of one name, and other values text."""
    root = ElementTree.Element(name)
    _fill(root, tree)
    return ElementTree.tostring(root, encoding="unicode")


def _fill(node: ElementTree.Element, value: Any) -> None:
    if isinstance(value, dict):
        for key, part in value.items():
            for each in part if isinstance(part, list) else [part]:
                _fill(ElementTree.SubElement(node, "".join(filter(str.isalnum, str(key))) or "_"), each)
    elif isinstance(value, list):
        for part in value:
            _fill(ElementTree.SubElement(node, "_"), part)
    elif value is not None:
        node.text = "".join(each for each in str(value)[:400] if each.isprintable())


_PIECES = (
    "\ufeff",
    "\0",
    "\r",
    "\n",
    "\t",
    " ",
    ",",
    ";",
    ":",
    '"',
    "'",
    "\\",
    "#",
    "&a ",
    "*a",
    "<<",
    "%",
    "!!python/object:os.x ",
)
_BRACKETS = (
    "[",
    "{",
    "]",
    "}",
    "<a>",
    "</a>",
    "<!--",
    "<![CDATA[",
    "- ",
    "a.",
    '{"a":',
    "'''",
    '"""',
    "\\u0000",
    "&lt;",
    "?",
    "-",
)
_ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-32", "latin-1", "cp037")


@st.composite
def texts(draw: st.DrawFn, valid: str) -> bytes:
    """Draw a valid text with up to three pieces removed, duplicated or replaced, in some encoding."""
    text = valid
    for _ in range(draw(st.integers(0, 3))):
        begin = draw(st.integers(0, len(text)))
        end = min(begin + draw(st.sampled_from((0, 1, 2, 10, 100))), len(text))
        action = draw(st.sampled_from(("cut", "double", "put", "brackets")))
        piece = {
            "cut": "",
            "double": text[begin:end] * 2,
            "put": draw(st.sampled_from((*_PIECES, *_BRACKETS))),
            "brackets": draw(st.sampled_from(_BRACKETS)) * draw(st.sampled_from((2, 90, 3000))),
        }[action]
        text = text[:begin] + piece + text[end:]
    encoding = draw(st.sampled_from(("utf-8", "utf-8", "utf-8", *_ENCODINGS)))
    return text.encode(encoding, "replace")


@st.composite
def blobs(draw: st.DrawFn, valid: bytes, head: int = 64) -> bytes:
    """Draw valid bytes with bits flipped, numbers overwritten, and pieces duplicated, removed or appended.

    About half of the changes are in the first ``head`` bytes.
    """
    data = bytearray(valid)
    for _ in range(draw(st.integers(0, 3))):
        if not data:
            break
        place = draw(st.integers(0, min(head, len(data)) - 1) | st.integers(0, len(data) - 1))
        action = draw(st.sampled_from(("flip", "number", "number", "cut", "truncate", "double", "append")))
        if action == "flip":
            data[place] ^= 1 << draw(st.integers(0, 7))
        elif action == "number":
            kind = draw(st.sampled_from(("<B", "<H", ">H", "<I", ">I", "<Q", ">Q")))
            most = (1 << (8 * struct.calcsize(kind))) - 1
            number = draw(st.sampled_from((0, 1, 7, 255, 20000, 65535, 1 << 20, 1 << 31, most - 1, most)))
            data[place : place + struct.calcsize(kind)] = struct.pack(kind, min(number, most))
        elif action == "cut":
            del data[place : place + draw(st.integers(1, 64))]
        elif action == "truncate":
            del data[place:]
        elif action == "double":
            data[place:place] = data[place : place + draw(st.integers(1, 64))]
        else:
            data += draw(st.binary(max_size=64))
    return bytes(data)


@st.composite
def pngs(draw: st.DrawFn, valid: bytes) -> bytes:
    """Draw a PNG with one chunk changed, removed, duplicated or renamed, and valid checksums."""
    chunks, place = [], 8
    while place < len(valid):
        length = int.from_bytes(valid[place : place + 4], "big")
        chunks.append((valid[place + 4 : place + 8], valid[place + 8 : place + 8 + length]))
        place += 12 + length
    number = draw(st.integers(0, len(chunks) - 1))
    kind, data = chunks[number]
    action = draw(st.sampled_from(("change", "change", "drop", "double", "kind")))
    if action == "change":
        chunks[number] = kind, draw(blobs(data, 13))
    elif action == "kind":
        chunks[number] = draw(st.sampled_from((b"tEXt", b"zTXt", b"PLTE", b"tRNS", b"acTL", b"fcTL", b"eXIf"))), data
    else:
        chunks[number : number + 1] = [] if action == "drop" else [chunks[number]] * 2
    written = (len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big") for kind, data in chunks)
    return valid[:8] + b"".join(written)


@st.composite
def models(draw: st.DrawFn, valid: str) -> str:
    """Draw an MJCF text with attributes changed, added or removed, and elements duplicated or removed; most of them load."""
    root = ElementTree.fromstring(valid)
    for _ in range(draw(st.integers(1, 3))):
        elements = [each for each in root.iter() if each is not root]
        element = draw(st.sampled_from(elements))
        action = draw(st.sampled_from(("number", "number", "number", "attribute", "drop attribute", "drop", "double")))
        name = draw(st.sampled_from(sorted(element.attrib))) if element.attrib else None
        if action == "number" and name is not None:
            parts = element.attrib[name].split()
            where = draw(st.integers(0, len(parts) - 1)) if parts else 0
            if parts and _is_number(parts[where]):
                parts[where] = draw(
                    st.sampled_from(("0", "-1", "1", "2", ".5", "1e-9", "1e9", "1e30", "64", parts[where] + "0"))
                )
                element.set(name, " ".join(parts))
        elif action == "attribute":
            key, value = draw(st.sampled_from(_ATTRIBUTES))
            element.set(key, value)
        elif action == "drop attribute" and name is not None:
            del element.attrib[name]
        elif action in ("drop", "double"):
            parent = next(each for each in root.iter() if element in list(each))
            if action == "drop":
                parent.remove(element)
            else:
                other = copy.deepcopy(element)
                for each in other.iter():
                    each.attrib.pop("name", None)
                parent.append(other)
    return ElementTree.tostring(root, encoding="unicode")


_ATTRIBUTES = (
    ("rgba", "0 0 0 0"),
    ("rgba", "1 1 1 .5"),
    ("type", "plane"),
    ("type", "sphere"),
    ("type", "directional"),
    ("type", "image"),
    ("mode", "targetbody"),
    ("mode", "trackcom"),
    ("fovy", "1"),
    ("fovy", "179"),
    ("orthographic", "true"),
    ("active", "false"),
    ("castshadow", "false"),
    ("texrepeat", "0 0"),
    ("texrepeat", "1e9 1e9"),
    ("texuniform", "true"),
    ("reflectance", "1"),
    ("emission", "1"),
    ("builtin", "gradient"),
    ("width", "1"),
    ("height", "6"),
    ("group", "5"),
    ("size", "1e-6 1e-6 1e-6"),
    ("size", "1e6 1e6 1e6"),
    ("nrow", "2"),
    ("material", "sky"),
    ("pos", "1e9 0 0"),
)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
