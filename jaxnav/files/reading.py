"""Strict reading of text, YAML and JSON from disk.

YAML is read with the scalars of YAML 1.2: `yes` is a word, `010` is ten and `1e-5` is a number.
Sizes, depths and numbers of values are bounded, duplicate keys and aliases are refused, and
OpenCV's matrices (`!!opencv-matrix`, in version 5 also `!!opencv-nd-matrix`) are read as mappings.
"""

import json
import re
import stat
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import yaml

from jaxnav.errors import BadInput
from jaxnav.files import limits


def read_mapping(path: Path) -> dict[str, Any]:
    """Read the mapping in a YAML or (`.json`) JSON file.

    Raises:
        BadInput: the file is unreadable, too large, not text, not YAML or JSON, or not a mapping.
    """
    is_json = path.suffix.lower() == ".json"
    text = read_text(path, limits.JSON_BYTES if is_json else limits.YAML_BYTES)
    data = parse_json(path, text) if is_json else parse_yaml(path, text)
    if data is None:
        raise BadInput(path, "the file is empty")
    if not isinstance(data, dict):
        names = {list: "list", str: "text", bool: "true/false"}
        got = names.get(type(data), type(data).__name__)
        raise BadInput(path, f"must be a mapping of keys to values, got a {got}")
    return data


def check_regular(path: Path) -> None:
    """Refuse what is no regular file, or leads to none, before it is opened: a pipe keeps its
    reader waiting for ever, a device such as /dev/zero has no end.

    Raises:
        BadInput: it is something else, missing, or out of reach.
    """
    with _naming(path):
        mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise BadInput(path, "is a folder, not a file")
    if not stat.S_ISREG(mode):
        raise BadInput(path, "is a device, a pipe or a socket: only regular files are read")


def open_file(path: Path) -> BufferedReader:
    """Open a regular file for reading.

    Raises:
        BadInput: it is no regular file, or can't be opened.
    """
    check_regular(path)
    with _naming(path):
        return path.open("rb")


@contextmanager
def naming(path: str | Path, problem: str, also: type[Exception] = OSError) -> Iterator[None]:
    """Turn the system's errors about a file, and others, into `BadInput`."""
    try:
        yield
    except (OSError, also) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise BadInput(path, f"{problem}: {reason.lower()}") from None


def _naming(path: Path) -> AbstractContextManager[None]:
    return naming(path, "can't be read", ValueError)  # ValueError: a NUL in the name


def read_text(path: Path, max_bytes: int) -> str:
    """Read a UTF-8 file of at most `max_bytes`.

    Raises:
        BadInput: it can't be read, is larger than that, or is not UTF-8.
    """
    with open_file(path) as file, _naming(path):
        raw = file.read(max_bytes + 1)
    if len(raw) > max_bytes:
        raise BadInput(path, f"is larger than {max_bytes // 2**20} MiB")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInput(path, f"is not UTF-8 text (byte {error.start})") from None


def parse_yaml(path: Path, text: str) -> Any:
    """Parse a text of YAML.

    Raises:
        BadInput: the text is not YAML, or holds too much.
    """
    # OpenCV 3 and 4 head their files with "%YAML:1.0", which is not a YAML directive.
    if text.startswith("%YAML:"):
        text = "#" + text
    try:
        _check_size(text)
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        # libyaml sees the end of a file on the line after its last one.
        last = max(len(text.splitlines()), 1)
        line = f"line {min(mark.line + 1, last)}: " if mark else ""
        problem = f"{line}{error.problem or error.context}"
    except yaml.YAMLError as error:  # a character that YAML does not allow
        problem = str(error).splitlines()[0]
    except (ValueError, OverflowError) as error:  # an escape beyond Unicode, 10 000 digits
        problem = str(error)
    raise BadInput(path, f"is not valid YAML: {problem}")


def parse_json(path: Path, text: str) -> Any:
    """Parse a text of JSON.

    Raises:
        BadInput: the text is not JSON, or holds too much.
    """
    # Every value follows one of these characters, and few of them are in texts.
    if sum(map(text.count, "[{,")) > limits.JSON_VALUES:
        raise BadInput(path, f"holds more than {limits.JSON_VALUES} values")
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:
        raise BadInput(path, f"is not valid JSON: {error}") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(mapping := dict(pairs)) < len(pairs):
        raise ValueError(f"duplicate key {first_repeated(key for key, _ in pairs)!r}")
    return mapping


def first_repeated(things: Iterable[Hashable]) -> Any:
    """The first thing that is there twice; None: there is none."""
    return next((thing for thing, count in Counter(things).items() if count > 1), None)


# libyaml: a tenth of the time. A PyYAML may have been built without it.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _check_size(text: str) -> None:
    """Refuse aliases, and more or deeper values than any honest file has, before any is made."""
    depth = values = 0
    for event in yaml.parse(text, Loader=_SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            _refuse("aliases (*name) are not supported", event)
        if isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.NodeEvent):
            values += 1
            depth += isinstance(event, yaml.CollectionStartEvent)
        if depth > limits.DEPTH:
            _refuse(f"nested deeper than {limits.DEPTH} levels", event)
        if values > limits.YAML_VALUES:
            _refuse(f"more than {limits.YAML_VALUES} values", event)


class _Loader(_SafeLoader):  # type: ignore[misc]
    """PyYAML's safe loader, stricter: keys are words and differ, scalars are those of YAML 1.2."""

    # PyYAML's own names, filled below.
    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012
    yaml_constructors: ClassVar[dict[Any, Any]] = {
        tag: construct
        for tag, construct in yaml.SafeLoader.yaml_constructors.items()
        if tag is None or tag.rpartition(":")[2] in ("map", "seq", "str")
    }

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        if not isinstance(node, yaml.MappingNode):
            _refuse("expected a mapping", node)
        mapping: dict[Hashable, Any] = {}
        for key_node, value_node in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                _refuse(f"the key {key!r} must be a word", key_node)
            if key in mapping:
                _refuse(f"duplicate key {key!r}", key_node)
            mapping[key] = self.construct_object(value_node, deep=deep)
        return mapping


def _refuse(problem: str, at: Any) -> NoReturn:
    raise yaml.constructor.ConstructorError(None, None, problem, at.start_mark)


_TAG = "tag:yaml.org,2002:"
_FLOAT = r"[-+]?(\.[0-9]+|[0-9]+\.[0-9]*|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?$"
_SPECIAL_FLOAT = r"[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN|Nan)$"


def _to_float(text: str) -> float:
    return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))


# The scalars of YAML 1.2: name, pattern, the characters it may start with, and what it makes.
_SCALARS: list[tuple[str, str, list[str], Callable[[str], Any]]] = [
    ("null", r"(~|null|Null|NULL|)$", ["~", "n", "N", ""], lambda text: None),
    ("bool", r"(true|True|TRUE|false|False|FALSE)$", list("tTfF"), lambda t: t[0] in "tT"),
    ("int", r"[-+]?[0-9]+$", list("-+0123456789"), int),
    ("float", f"{_FLOAT}|{_SPECIAL_FLOAT}", list("-+.0123456789"), _to_float),
]
for _name, _pattern, _first, _make in _SCALARS:
    _Loader.add_implicit_resolver(_TAG + _name, re.compile(_pattern), _first)
    _Loader.add_constructor(
        _TAG + _name, lambda loader, node, make=_make: make(loader.construct_scalar(node))
    )
for _name in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(
        _TAG + _name, lambda loader, node: loader.construct_mapping(node, deep=True)
    )
