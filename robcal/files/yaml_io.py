"""YAML files of people: safe reading with guards, line numbers for messages, and plain writing.

Numbers follow YAML 1.2 (``1e-6`` is a number, ``017`` is 17, ``on`` is text, a date is text); PyYAML's own 1.1 rules
would turn them into text, octal, booleans and dates.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from robcal.errors import InvalidInput
from robcal.files.storage import read_bytes

MAX_BYTES = 20_000_000
MAX_NODES = 2_000_000
MAX_DEPTH = 40

Location = tuple[str | int, ...]


class _Loader(yaml.SafeLoader):
    """Safe loader with YAML 1.2 scalars; duplicate keys are refused when the node tree is checked."""


_Loader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in (
    ("tag:yaml.org,2002:null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("tag:yaml.org,2002:bool", r"^(?:true|True|TRUE|false|False|FALSE)$", list("tTfF")),
    ("tag:yaml.org,2002:int", r"^[-+]?[0-9]+$", list("-+0123456789")),
    (
        "tag:yaml.org,2002:float",
        r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$",
        list("-+0123456789."),
    ),
    ("tag:yaml.org,2002:merge", r"^(?:<<)$", ["<"]),
):
    _Loader.add_implicit_resolver(_tag, re.compile(_pattern), _first)


def _construct_int(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    text = str(loader.construct_scalar(node))
    if len(text) > 400:  # int() itself refuses from 4300 digits on, with words for programmers
        raise yaml.constructor.ConstructorError(None, None, "a number with more than 400 digits", node.start_mark)
    return int(text)


def _construct_float(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> float:
    text = str(loader.construct_scalar(node)).lower()
    return float(text.replace(".inf", "inf").replace(".nan", "nan") if text.lstrip("+-")[1:2].isalpha() else text)


_Loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _construct_float)


@dataclass(frozen=True)
class YamlDocument:
    """A parsed YAML file and the line in which every entry stands."""

    path: Path
    data: Any
    lines: Mapping[Location, int] = field(repr=False)

    def line(self, location: Sequence[str | int]) -> int | None:
        """Line (from 1) of an entry, or of the nearest enclosing one."""
        place = tuple(location)
        while place not in self.lines and place:
            place = place[:-1]
        return self.lines.get(place)


def _expanded(node: yaml.Node, sizes: dict[int, int]) -> int:
    """Entries that a node has with its aliases written out; ``sizes`` by identity, so that none is counted again."""
    if id(node) not in sizes:
        sizes[id(node)] = 1  # of an alias inside itself
        children: list[yaml.Node] = []
        if isinstance(node, yaml.CollectionNode):
            pairs = isinstance(node, yaml.MappingNode)
            children = [child for _, child in node.value] if pairs else node.value
        sizes[id(node)] = 1 + sum(_expanded(child, sizes) for child in children)
    return sizes[id(node)]


def _walk(node: yaml.Node, place: Location, lines: dict[Location, int], path: Path) -> None:
    if len(place) > MAX_DEPTH:
        raise InvalidInput(f"{path}, line {node.start_mark.line + 1}: nested more than {MAX_DEPTH} levels deep")
    lines.setdefault(place, node.start_mark.line + 1)
    if isinstance(node, yaml.SequenceNode):
        for i, child in enumerate(node.value):
            _walk(child, (*place, i), lines, path)
    elif isinstance(node, yaml.MappingNode):
        seen: dict[str, int] = {}
        for key, child in node.value:
            line = key.start_mark.line + 1
            if not isinstance(key, yaml.ScalarNode):
                raise InvalidInput(f"{path}, line {line}: a key must be a word, not a list or a mapping")
            if key.tag.endswith(":merge"):
                raise InvalidInput(f"{path}, line {line}: the merge key '<<' is not supported: write the entries out")
            if key.value in seen:
                raise InvalidInput(
                    f"{path}, line {line}: key '{key.value}' stands twice (first in line {seen[key.value]}): remove one"
                )
            seen[key.value] = line
            _walk(child, (*place, key.value), lines, path)
            lines[(*place, key.value)] = line


def read_yaml(path: Path) -> YamlDocument:
    """Read a YAML file with one mapping at the top.

    Raises
    ------
    InvalidInput : unreadable, too large, not YAML, duplicate keys, alias bombs, or not a mapping.
    """
    raw = read_bytes(path, MAX_BYTES)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise InvalidInput(f"{path}, line {line}: not UTF-8 text: save the file as UTF-8") from None
    try:
        loader = _Loader(text)
    except yaml.reader.ReaderError as error:
        line = text[: error.position].count("\n") + 1
        raise InvalidInput(
            f"{path}, line {line}: not a text file: it holds the control character #x{ord(text[error.position]):02x}"
        ) from None
    try:
        node = loader.get_single_node()
        lines: dict[Location, int] = {}
        if node is not None:
            if _expanded(node, {}) > MAX_NODES:
                raise InvalidInput(
                    f"{path}: expands to more than {MAX_NODES} entries (aliases that multiply): write them out"
                )
            _walk(node, (), lines, path)
        data = loader.construct_document(node) if node is not None else None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f", line {mark.line + 1}" if mark else ""
        problem = " ".join(str(error.problem or error.context or "").split())
        raise InvalidInput(f"{path}{where}: not valid YAML: {problem}") from None
    except (yaml.YAMLError, ValueError) as error:
        raise InvalidInput(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise InvalidInput(f"{path}: nested too deeply (an alias inside itself?): {MAX_DEPTH} levels at most") from None
    finally:
        loader.dispose()
    if not isinstance(data, dict):
        raise InvalidInput(f"{path}: must be a YAML mapping ('key: value' lines), found {type(data).__name__}")
    return YamlDocument(path, {str(k): v for k, v in data.items()}, lines)


class _Dumper(yaml.SafeDumper):
    """Block style outside, flow style for lists of numbers and for marked mappings; no aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


class FlowMapping(dict[str, Any]):
    """A mapping that is written in one line."""


def _represent_float(dumper: yaml.SafeDumper, value: float) -> yaml.ScalarNode:
    text = repr(float(value)).replace("inf", ".inf").replace("nan", ".nan")
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")  # readers of YAML 1.1 take 1e-07 for text
    return dumper.represent_scalar("tag:yaml.org,2002:float", text)


def _represent_list(dumper: yaml.SafeDumper, value: list[Any]) -> yaml.SequenceNode:
    flat = all(not isinstance(item, dict | list) for item in value)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=flat)


_Dumper.add_representer(float, _represent_float)
_Dumper.add_representer(list, _represent_list)
_Dumper.add_representer(
    FlowMapping, lambda dumper, value: dumper.represent_mapping("tag:yaml.org,2002:map", value.items(), flow_style=True)
)


def yaml_text(data: Mapping[str, Any], comment: str = "") -> str:
    """YAML text of plain data in the order given; every float is written so that it reads back exactly."""
    body = yaml.dump(dict(data), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=200)
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    return head + body
