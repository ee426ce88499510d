"""rosbags' readers with bounds on what a bag of any bytes may declare and unpack to.

A bag is refused, by an exception like its reader's own, before it takes more than
`jaxnav.files.limits` allows: for a chunk, all chunks together, an index, or a definition.
"""

import struct
import threading
from collections.abc import Callable, Collection, Generator, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import apsw
from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.rosbag1 import Reader as _Ros1Reader
from rosbags.rosbag1.reader import Chunk, ChunkInfo, IndexData
from rosbags.rosbag2 import Reader as _Ros2Reader
from rosbags.rosbag2 import reader as _rosbag2
from rosbags.rosbag2 import storage_mcap as _mcap
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from jaxnav.files import limits
from jaxnav.files.reading import check_regular
from jaxnav.files.unpacking import Budget, unpack_chunk, zstd_pieces

RULE = "=" * 80 + "\n"  # between the definitions of a message's parts
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_SIZES = {"8": 1, "bool": 1, "byte": 1, "char": 1, "16": 2, "32": 4, "64": 8, "128": 16}


class Ros1Reader(_Ros1Reader):
    """rosbags' reader of .bag files, with bounds."""

    def __init__(self, path: Path):
        _Ros1Reader.__init__(self, path)
        self._budget = Budget.of_file(path)
        self._connections = self._entries = 0
        # The chunks that were unpacked last: where chunks overlap in time, messages in their order
        # of time alternate between them.
        self._kept: dict[int, bytes] = {}

    def read_connection(self) -> Connection:
        """See rosbags."""
        self._connections += 1
        if self._connections > limits.CONNECTIONS:
            raise ValueError(f"more than {limits.CONNECTIONS} connections")
        return _Ros1Reader.read_connection(self)

    def read_chunk_info(self) -> ChunkInfo:
        """See rosbags."""
        self._count_entries(1)
        return _Ros1Reader.read_chunk_info(self)

    def read_chunk(self) -> Chunk:
        """See rosbags."""
        chunk = _Ros1Reader.read_chunk(self)
        kind = next(k for k, unpack in _ros1_decompressors.items() if unpack is chunk.decompressor)
        return chunk._replace(decompressor=partial(self._unpacked, kind, chunk.datapos))

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """See rosbags. An index counts each time it is read, as two chunks may name the same."""
        assert self.bio is not None
        begin = self.bio.tell()
        _, (size,) = self.bio.seek(begin + 51), struct.unpack("<L", self.bio.read(4))
        self.bio.seek(begin)
        self._count_entries(1 + size // 12)
        _Ros1Reader.read_index_data(self, pos, indexes)

    def _count_entries(self, count: int) -> None:
        self._entries += count
        if self._entries > limits.INDEX_ENTRIES:
            raise ValueError(f"an index of more than {limits.INDEX_ENTRIES} entries")

    def _unpacked(self, kind: str, position: int, data: bytes) -> bytes:
        if position not in self._kept:
            self._kept[position] = unpack_chunk(kind, data, self._budget)
            while len(self._kept) > 1 and sum(map(len, self._kept.values())) > limits.CHUNK_BYTES:
                del self._kept[next(iter(self._kept))]
        return self._kept[position]


class Ros2Reader(_Ros2Reader):
    """rosbags' reader of folders, .db3 and .mcap files, with bounds."""

    def __init__(self, path: Path):
        _Ros2Reader.__init__(self, path)
        self._budget = Budget(0)
        for file in path.iterdir() if path.is_dir() else [path]:
            if not file.is_dir():
                check_regular(file)
            self._budget.left += Budget.of_file(file).left
        metadata = path / "metadata.yaml"
        if path.is_dir() and metadata.stat().st_size > limits.YAML_BYTES:
            raise ValueError(
                f"{metadata.name} is larger than {limits.YAML_BYTES // limits.MIB} MiB"
            )

    def open(self) -> None:
        """See rosbags."""
        with _spending(self._budget):
            _Ros2Reader.open(self)

    def messages(
        self, connections: Collection[Connection] = (), start: Any = None, stop: Any = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """See rosbags."""
        iterator = _Ros2Reader.messages(self, connections, start, stop)
        while True:
            with _spending(self._budget):
                one = next(iterator, None)
            if one is None:
                return
            yield one


def messages(
    reader: Ros1Reader | Ros2Reader, connections: Collection[Connection], known: dict[str, str]
) -> Iterator[tuple[Connection, int, Any]]:
    """The messages of some connections with the times, in ns, at which they were received.

    Args:
        known: definitions of types that a bag may use without one.

    Raises:
        Exception: any of rosbags, or a definition or a message is too long or declares too much.
    """
    types = typestore(connections, known)
    is_ros1 = isinstance(reader, Ros1Reader)
    deserialize = types.deserialize_ros1 if is_ros1 else types.deserialize_cdr
    for connection, received_ns, raw in reader.messages(connections) if connections else ():
        kind = connection.msgtype
        if kind not in _IMAGES and len(raw) > limits.MESSAGE_BYTES:
            raise ValueError(f"a message of {len(raw)} bytes")
        yield connection, received_ns, deserialize(raw, kind)


def typestore(connections: Collection[Connection], known: dict[str, str]) -> Any:
    """The message types of some connections; arguments and errors as in `messages`."""
    undefined = {c.msgtype for c in connections if c.msgdef.format is MessageDefinitionFormat.NONE}
    types = get_typestore(Stores.ROS2_HUMBLE if undefined else Stores.EMPTY)
    for kind in undefined - types.fielddefs.keys():
        if kind not in known:
            raise ValueError(f"the bag holds no definition of {kind}")
        types.register(get_types_from_msg(known[kind], kind))
    for connection in connections:
        definition = connection.msgdef
        if len(definition.data) > limits.DEFINITION_BYTES:
            raise ValueError(f"the definition of {connection.msgtype} is too long")
        if definition.format is MessageDefinitionFormat.MSG:
            _register(types, get_types_from_msg(definition.data, connection.msgtype))
        elif definition.format is MessageDefinitionFormat.IDL:
            for part in definition.data.split(RULE):
                # Each part is headed by `IDL: package/msg/Type`, unless there is only one.
                text = part.partition("\n")[2] if part.startswith("IDL: ") else part
                if text.strip():
                    _register(types, get_types_from_idl(text))
    return types


def _register(types: Any, definitions: Any) -> None:
    """Add types; refuse one whose messages take more memory than their bytes account for."""
    least: dict[str, int] = {}

    def least_bytes(name: str, above: tuple[str, ...]) -> int:
        if name in above or len(above) > limits.DEPTH:
            raise ValueError(f"{name} holds itself")
        if name not in least:
            definition = definitions.get(name) or types.fielddefs.get(name)
            fields = definition[1] if definition else ()
            least[name] = sum(of_field(field[1], (*above, name)) for field in fields)
        return least[name]

    def of_field(field: Any, above: tuple[str, ...]) -> int:
        if field[0] == Nodetype.NAME:
            return least_bytes(field[1], above)
        if field[0] == Nodetype.BASE:
            name = field[1][0]
            return 4 if name == "string" else next(n for w, n in _SIZES.items() if name.endswith(w))
        inner, length = field[1]
        size = of_field(inner, above)
        if not size:
            raise ValueError("a list of messages without content")
        if field[0] == Nodetype.SEQUENCE:
            return 4
        is_plain = inner[0] == Nodetype.BASE and inner[1][0] != "string"
        if length > (limits.MESSAGE_BYTES if is_plain else limits.LIST_LENGTH):
            raise ValueError(f"a list of {length} entries in every message")
        return int(length) * size

    for name in definitions:
        if least_bytes(name, ()) > limits.MESSAGE_BYTES:
            raise ValueError(f"{name} is larger than any message")
    types.register(definitions)


# rosbags' own tables and names, by which it unpacks without a budget.
_ros1_decompressors = _Ros1Reader.read_chunk.__globals__["decompressors"]
_now = threading.local()


@contextmanager
def _spending(budget: Budget) -> Iterator[None]:
    """Take the bytes that rosbags unpacks in this block and this thread from a budget."""
    before, _now.budget = getattr(_now, "budget", None), budget
    try:
        yield
    finally:
        _now.budget = before


def _bounded(kind: str) -> Callable[..., bytes]:
    return lambda data, *_: unpack_chunk(kind, data, getattr(_now, "budget", None) or Budget(0))


class _Zstd:
    """A replacement of rosbags' zstd module, for folders whose files or messages are packed."""

    decompress = staticmethod(_bounded("zstd"))

    @staticmethod
    @contextmanager
    def open(file: IO[bytes], mode: str) -> Iterator[Any]:
        """The unpacked file, with the `read` that `shutil.copyfileobj` calls."""
        pieces, budget = zstd_pieces(file), getattr(_now, "budget", None) or Budget(0)

        def read(size: int) -> bytes:
            piece = next(pieces, b"")
            budget.take(len(piece))
            return piece

        yield SimpleNamespace(read=read)


_mcap.DECOMPRESSORS.update({kind: _bounded(kind) for kind in ("", "lz4", "zstd")})
_rosbag2.zstd = _Zstd  # type: ignore[assignment]


def _limit(connection: apsw.Connection) -> None:
    """Bound the length of values and the steps of queries, as a table may make its values up."""
    connection.limit(apsw.SQLITE_LIMIT_LENGTH, limits.CHUNK_BYTES)
    steps = iter(range(limits.SQLITE_STEPS // 1_000_000))
    connection.set_progress_handler(lambda: next(steps, None) is None, 1_000_000)


apsw.connection_hooks.append(_limit)
