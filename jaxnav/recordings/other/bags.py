"""Read messages from ROS 1 and ROS 2 bags without ROS, in the order of their reception.

    ROS 1   drive.bag, drive.bag.bz2
    ROS 2   a folder with metadata.yaml and .db3 or .mcap files, or one such file alone

Message definitions come from the bag itself. ROS 2 wrote none into .db3 files up to its release
Humble: these are read by rosbags' definitions of that release, and a few of packages outside it.
A bag is refused before it takes more than `jaxnav.files.limits` allows: rosbags' decompressors
share a budget of bytes, and indexes, definitions and messages are bounded.
"""

import tempfile
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import apsw
from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.rosbag1 import reader as _rosbag1
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.rosbag2 import reader as _rosbag2
from rosbags.rosbag2 import storage_mcap as _mcap
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from jaxnav.errors import BadInput
from jaxnav.files import limits
from jaxnav.files.ranges import problem_of
from jaxnav.files.reading import check_regular, open_file
from jaxnav.files.unpacking import Budget, copy_bz2, unpack_chunk, zstd_pieces

_ROS2_FILES = (".db3", ".mcap")
_LONGEST = 200  # characters of a library's message about broken bytes, which may quote all of them
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_SIZES = {"8": 1, "bool": 1, "byte": 1, "char": 1, "16": 2, "32": 4, "64": 8, "128": 16}
_RULE = "=" * 80 + "\n"  # between the definitions of a message's parts
# Of apriltag_msgs 2 and ackermann_msgs 2.
_DEFINITIONS = {
    "apriltag_msgs/msg/AprilTagDetectionArray": f"""std_msgs/Header header
AprilTagDetection[] detections
{_RULE}MSG: apriltag_msgs/AprilTagDetection
string family
int32 id
int32 hamming
float32 goodness
float32 decision_margin
Point centre
Point[4] corners
float64[9] homography
{_RULE}MSG: apriltag_msgs/Point
float64 x
float64 y
""",
    "ackermann_msgs/msg/AckermannDriveStamped": f"""std_msgs/Header header
AckermannDrive drive
{_RULE}MSG: ackermann_msgs/AckermannDrive
float32 steering_angle
float32 steering_angle_velocity
float32 speed
float32 acceleration
float32 jerk
""",
}


@dataclass(frozen=True)
class ReceivedMessage:
    """A message, with its topic, its type, and the time at which the recorder received it."""

    topic: str
    kind: str  # its type, as `nav_msgs/msg/Odometry`
    received_ns: int
    message: Any


# All topics of a bag with their types -> those to read; raises BadInput where they do not suffice.
Choose = Callable[[Mapping[str, str]], Collection[str]]


def is_ros1_bag(path: Path) -> bool:
    """Whether a file's name is that of a ROS 1 bag."""
    return path.name.endswith((".bag", ".bag.bz2"))


def read_messages(path: Path, choose: Choose, take: Callable[[ReceivedMessage], object]) -> None:
    """Read the messages of some topics of a bag.

    Args:
        take: called with each message.

    Raises:
        BadInput: the path is no bag, a broken one, or one that ends too early; `take` raises
            something; or `choose` raises it.
    """
    if path.is_dir():
        if not (path / "metadata.yaml").exists():
            raise BadInput(path, "is no ROS 2 bag: it holds no metadata.yaml")
        _read(path, path, Ros2Reader, choose, take)
    elif path.suffix in _ROS2_FILES and path.exists():
        _read(path, path, Ros2Reader, choose, take)
    elif is_ros1_bag(path):
        with decompress_bag(path) as plain:
            _read(path, plain, _Ros1Reader, choose, take)
    elif not path.exists():
        raise BadInput(path, "there is no such file or folder")
    else:
        raise BadInput(
            path, "is no ROS bag: expected a .bag, a .bag.bz2 or the folder of a ROS 2 bag"
        )


@contextmanager
def decompress_bag(path: Path) -> Iterator[Path]:
    """The path of the bag, or of a decompressed copy that is removed after the block."""
    open_file(path).close()
    if path.suffix != ".bz2":
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="jaxnav-") as folder:
        plain = Path(folder) / path.stem
        try:
            with plain.open("wb") as target:
                copy_bz2(path, target, Budget.from_file(path))
        except (OSError, EOFError, ValueError) as error:
            raise BadInput(path, f"can't be decompressed: {str(error).lower()}") from None
        yield plain


def _read(
    path: Path,
    plain: Path,
    reader_class: Any,
    choose: Choose,
    take: Callable[[ReceivedMessage], object],
) -> None:
    taken = ""  # the topic of the message that is taken
    try:
        _unpacking.budget, _unpacking.kept = _budget(plain), {}
        with reader_class(plain) as reader:
            if len(reader.connections) > limits.CONNECTIONS:
                raise ValueError(f"more than {limits.CONNECTIONS} connections")
            chosen = choose({c.topic: c.msgtype for c in reader.connections})
            connections = [c for c in reader.connections if c.topic in chosen]
            types = typestore(connections)
            deserialize = types.deserialize_cdr
            if reader_class is _Ros1Reader:
                deserialize = types.deserialize_ros1
            for connection, received_ns, raw in reader.messages(connections) if connections else ():
                topic, kind = connection.topic, connection.msgtype
                if kind not in _IMAGES and len(raw) > limits.MESSAGE_BYTES:
                    raise ValueError(f"a message of {len(raw)} bytes")
                message = deserialize(raw, kind)
                if not isinstance(received_ns, int):
                    raise ValueError(f"a message of {topic} has no time")
                if problem := problem_of("stamp_ns", received_ns):
                    raise ValueError(f"the time of a message of {topic} {problem}")
                taken = topic
                take(ReceivedMessage(topic, kind, received_ns, message))
                taken = ""
    except BadInput:
        raise
    except Exception as error:
        # The reader may meet any bytes, and raises whatever they lead to. A definition in the bag
        # may differ from the one that its name promises.
        problem = (
            f"{taken}: a message can't be understood" if taken else "is not a readable ROS bag"
        )
        text = " ".join(str(error).split())
        text = text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
        raise BadInput(path, f"{problem} ({type(error).__name__}: {text})") from None
    finally:
        _unpacking.budget = _unpacking.kept = None


# --- definitions ---


def typestore(connections: Collection[Connection]) -> Any:
    """The message types of some connections.

    Raises:
        Exception: any of rosbags, or a definition is too long or declares too much.
    """
    undefined = {c.msgtype for c in connections if c.msgdef.format is MessageDefinitionFormat.NONE}
    types = get_typestore(Stores.ROS2_HUMBLE if undefined else Stores.EMPTY)
    for kind in undefined - types.fielddefs.keys():
        if kind not in _DEFINITIONS:
            raise ValueError(f"the bag holds no definition of {kind}")
        types.register(get_types_from_msg(_DEFINITIONS[kind], kind))
    for connection in connections:
        definition = connection.msgdef
        if len(definition.data) > limits.DEFINITION_BYTES:
            raise ValueError(f"the definition of {connection.msgtype} is too long")
        if definition.format is MessageDefinitionFormat.MSG:
            _register(types, get_types_from_msg(definition.data, connection.msgtype))
        elif definition.format is MessageDefinitionFormat.IDL:
            for part in definition.data.split(_RULE):
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


# --- what rosbags may unpack and index ---


class _Unpacking(threading.local):
    """Of the bag that this thread reads here: a budget, and the chunks that were unpacked last.

    Where chunks overlap in time, messages in their order of time alternate between them.
    """

    budget: Budget | None = None  # none where somebody else uses rosbags
    kept: dict[bytes, bytes] | None = None


_unpacking = _Unpacking()


def _budget(path: Path) -> Budget:
    """The budget of a bag's files together, which are regular ones."""
    metadata = path / "metadata.yaml"
    if path.is_dir() and metadata.stat().st_size > limits.YAML_BYTES:
        raise ValueError(f"{metadata.name} is larger than {limits.YAML_BYTES // limits.MIB} MiB")
    budget = Budget(0)
    for file in path.iterdir() if path.is_dir() else [path]:
        if not file.is_dir():
            check_regular(file)
        budget.left += Budget.from_file(file).left
    return budget


def _bounded(kind: str, plain: Callable[..., bytes], keeps: bool = False) -> Callable[..., bytes]:
    """One of rosbags' decompressors, which takes what it unpacks from the budget."""

    def unpack(data: bytes, *more: Any) -> bytes:
        if _unpacking.budget is None:
            return plain(data, *more)
        kept = _unpacking.kept if keeps and _unpacking.kept is not None else {}
        if data not in kept:
            kept[data] = unpack_chunk(kind, data, _unpacking.budget)
            while len(kept) > 1 and sum(map(len, kept.values())) > limits.CHUNK_BYTES:
                del kept[next(iter(kept))]
        return kept[data]

    return unpack


class _Zstd:
    """A replacement of rosbags' zstd module, for folders whose files or messages are packed."""

    decompress = staticmethod(_bounded("zstd", _rosbag2.zstd.decompress))

    @staticmethod
    @contextmanager
    def open(file: IO[bytes], mode: str) -> Iterator[Any]:
        """The unpacked file, with the `read` that `shutil.copyfileobj` calls."""
        budget, pieces = _unpacking.budget, zstd_pieces(file)

        def read(size: int) -> bytes:
            piece = next(pieces, b"")
            if budget is not None:
                budget.take(len(piece))
            return piece

        yield SimpleNamespace(read=read)


class _Ros1Reader(_rosbag1.Reader):
    """rosbags' reader of .bag files, with a bound on its index."""

    _entries = 0

    def read_index_data(self, pos: int, indexes: dict[int, list[Any]]) -> None:
        """See rosbags. An index counts each time it is read, as two chunks may name the same."""
        assert self.bio is not None
        begin = self.bio.tell()
        _rosbag1.Reader.read_index_data(self, pos, indexes)
        self._entries += (self.bio.tell() - begin) // 12
        if self._entries > limits.INDEX_ENTRIES:
            raise ValueError(f"an index of more than {limits.INDEX_ENTRIES} entries")


_tables: list[tuple[Any, bool]] = [(_rosbag1.decompressors, True), (_mcap.DECOMPRESSORS, False)]
for _table, _keeps in _tables:
    _table.update({kind: _bounded(kind, plain, _keeps) for kind, plain in _table.items()})
_rosbag2.zstd = _Zstd  # type: ignore[assignment]


def _limit(connection: apsw.Connection) -> None:
    """Bound the length of values and the steps of queries, as a table may make its values up."""
    connection.limit(apsw.SQLITE_LIMIT_LENGTH, limits.CHUNK_BYTES)
    steps = iter(range(limits.SQLITE_STEPS // 1_000_000))
    connection.set_progress_handler(lambda: next(steps, None) is None, 1_000_000)


apsw.connection_hooks.append(_limit)
