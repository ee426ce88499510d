"""The messages of a recorded drive: their fields, JSON schemas, writers, readers and checks.

    topic       schema              one for
    /odometry   jaxnav.Odometry     a reading of a car's odometer, as it was read
    /twist      jaxnav.Twist        a reading of another base's odometer
    /frames     jaxnav.Frames       what cameras saw at one instant
    /tick       jaxnav.Tick         an input without data
    /outcome    jaxnav.Outcome      what the pilot made of an input
    of images   foxglove.CompressedImage

The first four are the pilot's inputs, in the order in which it handled them. Each may hold what a
gyro has measured since the one before. Each field of an outcome is one line of `Outcomes`: it is
the record of one outcome in a message, and of N in a table.
"""

import base64
import binascii
import enum
import functools
import hashlib
import json
import math
import operator
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated, Any, ClassVar, Literal, get_type_hints

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    PlainValidator,
    WithJsonSchema,
    create_model,
    model_validator,
)
from pydantic_core import core_schema

from jaxnav.core.filter.planar import planar_poses
from jaxnav.core.models.origin import inverses_in_world, planar_in_world
from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault, Health, Reject
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import MOST_TURNS, GyroReading, Odometry, Reading, reading_of
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.errors import BadInput
from jaxnav.files import limits
from jaxnav.files.ranges import RANGES
from jaxnav.files.validation import Count, Entry
from jaxnav.recordings.drive_format import NOT_FINITE
from jaxnav.recordings.learnt import errors_of, repeated_share

ODOMETRY, TWIST, FRAMES, TICK, OUTCOME = "/odometry", "/twist", "/frames", "/tick", "/outcome"
IMAGE_SCHEMA = "foxglove.CompressedImage"
_NIS_SLACK = 1e3  # NIS is in units of sigma, which is a millimetre
_MOST_KNOWN = 1000  # lists of words whose flags are cached
_MOST_SIDES = 32  # of a covariance: a state has 6 to 9 numbers
_NOTHING = Detections.concatenate([])

# --- types of fields ---

# JSON schema's name of a type -> the check of its values, and their dtype.
_ITEMS: dict[str, tuple[core_schema.CoreSchema, type]] = {
    "number": (core_schema.float_schema(strict=True), float),
    "integer": (core_schema.int_schema(strict=True, ge=-(2**63), lt=2**63), int),
    "boolean": (core_schema.bool_schema(strict=True), bool),
}


@dataclass(frozen=True)
class Array:
    """A field that reads a flat list as an array, row by row.

    Attributes:
        items: type of the values, as JSON schema names it.
        shape: shape of the array; its first axis may be -1, of any length.
    """

    items: str = "number"
    shape: tuple[int, ...] = (-1,)

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        # The values are checked by compiled code: a drive has a million lists.
        check, dtype = _ITEMS[self.items]
        row = math.prod(size for size in self.shape if size > 0)
        is_fixed, inner = -1 not in self.shape, self.shape[1:]
        first = self.shape[0] if is_fixed else 0

        def shaped(values: list[Any]) -> np.ndarray:
            if len(values) % row or (is_fixed and len(values) != row):
                raise ValueError(f"must hold {row} values{'' if is_fixed else ' a row'}")
            # Not -1, which NumPy can't find for an empty array.
            return np.array(values, dtype).reshape(first or len(values) // row, *inner)

        listed = core_schema.list_schema(check, strict=True)
        return core_schema.no_info_after_validator_function(shaped, listed)

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        return {"type": "array", "items": {"type": self.items}}


def _words(kind: type[enum.Enum]) -> PlainValidator:
    """A field that reads flags from the list of their names, or an enum from its name."""
    members, is_flags = kind.__members__, issubclass(kind, enum.IntFlag)

    @functools.lru_cache(_MOST_KNOWN)
    def known(words: Any) -> Any:
        return functools.reduce(operator.or_, map(members.__getitem__, words), kind(0))

    def read(value: Any) -> Any:
        if is_flags and not isinstance(value, list):
            raise ValueError("must be a list")
        try:
            return known(tuple(value)) if is_flags else members[value]
        except (KeyError, TypeError):  # TypeError: holds what is no text
            words = value if is_flags else [value]
            odd = next(w for w in words if not isinstance(w, str) or w not in members)
            raise ValueError(f"unknown word {str(odd)[:40]!r}") from None

    word: Any = Literal[tuple(members)]
    return PlainValidator(read, json_schema_input_type=list[word] if is_flags else word)


def _bytes(value: Any) -> bytes:
    try:
        return base64.b64decode(value, validate=True)
    except (binascii.Error, TypeError, ValueError):
        raise ValueError("must be base64") from None


def _square(array: np.ndarray) -> np.ndarray:
    side = math.isqrt(array.size)
    if side**2 != array.size or side > _MOST_SIDES:
        raise ValueError(f"must be a square matrix, got {array.size} values")
    return array.reshape(side, side)


_STAMP, _INDEX = RANGES["stamp_ns"], RANGES["index"]
_LEAST_NS, _MOST_NS = int(_STAMP.least), int(_STAMP.most)
Now = Annotated[int, Field(strict=True, ge=0, lt=_MOST_NS + 1)]  # ns, the loop's own clock
Index = Annotated[int, Field(strict=True, ge=int(_INDEX.least), le=int(_INDEX.most))]  # -1: none
Stamp = Annotated[int, Field(strict=True, ge=_LEAST_NS, le=_MOST_NS)]  # ns, whatever a driver says
Real = Annotated[float, Field(strict=True)]  # also NaN and infinite
Flag = Annotated[bool, Field(strict=True)]
Word = Annotated[str, Field(strict=True)]
Faults = Annotated[Fault, _words(Fault)]
Base64 = Annotated[
    bytes, BeforeValidator(_bytes), WithJsonSchema({"type": "string", "contentEncoding": "base64"})
]

# --- inputs ---


class FrameMessage(Entry):
    """A `FrameDetections` with N detections; N = 0 where the frame was not usable."""

    camera: Count
    stamp_ns: Stamp
    usable: Flag
    ids: Annotated[Int[np.ndarray, " N"], Array("integer")]
    families: list[Word]
    corners_px: Annotated[Float[np.ndarray, "N 4 2"], Array(shape=(-1, 4, 2))]
    sigma_px: Annotated[Float[np.ndarray, "N 4"], Array(shape=(-1, 4))]
    refined: Annotated[Bool[np.ndarray, " N"], Array("boolean")]
    faults: Faults

    @model_validator(mode="after")
    def _agrees(self) -> "FrameMessage":
        fields = (self.ids, self.families, self.corners_px, self.sigma_px, self.refined)
        if len({len(field) for field in fields}) > 1:
            raise ValueError("ids, families, corners_px, sigma_px and refined must agree in number")
        if len(self.ids) > limits.IN_VIEW:
            raise ValueError(f"has more than {limits.IN_VIEW} detections")
        if not self.usable and len(self.ids):
            raise ValueError("a frame that was not usable has no detections")
        return self

    def frame(self) -> FrameDetections:
        """The frame of this message."""
        detections = None
        if self.usable:
            columns = self.ids, self.corners_px, self.sigma_px, self.refined
            detections = Detections(*columns, tuple(self.families))
        return FrameDetections(self.camera, self.stamp_ns, detections, self.faults)


class GyroMessage(Entry):
    """A `GyroReading`."""

    stamp_ns: Stamp
    turn_radps: Real


class TickMessage(Entry):
    """An `Input` without odometry and frames."""

    VALUES: ClassVar[tuple[str, ...]] = ()  # the fields of a reading, in the order of `values`
    now_ns: Now
    faults: Faults
    gyro: list[GyroMessage] = Field(default_factory=list, max_length=MOST_TURNS)

    def input(self) -> Input:
        """The input of this message."""
        frames = tuple(frame.frame() for frame in getattr(self, "frames", ()))
        gyro = tuple(GyroReading(one.stamp_ns, one.turn_radps) for one in self.gyro)
        reading, fields = None, vars(self)
        if self.VALUES:
            values = [fields[name] for name in self.VALUES]
            reading = reading_of(fields["stamp_ns"], values, fields["valid"])
        return Input(self.now_ns, reading, frames, self.faults, gyro)


class FramesMessage(TickMessage):
    """An `Input` of frames that were handled together."""

    frames: Annotated[list[FrameMessage], Field(min_length=1)]


class ReadingMessage(TickMessage):
    """What the two kinds of odometry share: its stamp, and the frames that showed nothing."""

    stamp_ns: Stamp
    valid: Flag
    frames: list[FrameMessage] = Field(default_factory=list)


class OdometryMessage(ReadingMessage):
    """An `Input` with `Odometry`."""

    VALUES = ("speed_mps", "steering_rad")
    speed_mps: Real
    steering_rad: Real


class TwistMessage(ReadingMessage):
    """An `Input` with `TwistOdometry`."""

    VALUES = ("forward_mps", "left_mps", "turn_radps")
    forward_mps: Real
    left_mps: Real
    turn_radps: Real


def input_message(given: Input) -> tuple[str, int, dict[str, Any]]:
    """The topic, stamp in ns and message of an input: the arguments of `Recorder.put`."""
    message: dict[str, Any] = {"now_ns": given.now_ns, "faults": given.faults}
    if given.frames:
        message["frames"] = [_frame_message(frame) for frame in given.frames]
    if given.gyro:
        message["gyro"] = [_reading_message(one, "turn_radps") for one in given.gyro]
    reading = given.odometry
    if reading is None:
        topic, stamp_ns = (FRAMES, given.frames[0].stamp_ns) if given.frames else (TICK, None)
        return topic, given.now_ns if stamp_ns is None else stamp_ns, message
    of_car = isinstance(reading, Odometry)
    names = (OdometryMessage if of_car else TwistMessage).VALUES
    message |= _reading_message(reading, *names) | {"valid": bool(reading.valid)}
    return ODOMETRY if of_car else TWIST, reading.stamp_ns, message


def _reading_message(reading: Reading | GyroReading, *names: str) -> dict[str, Any]:
    values = {name: float(getattr(reading, name)) for name in names}
    return {"stamp_ns": _recordable(reading.stamp_ns)} | values


def _frame_message(frame: FrameDetections) -> dict[str, Any]:
    found = _NOTHING if frame.detections is None else frame.detections
    return {
        "camera": frame.camera,
        "stamp_ns": _recordable(frame.stamp_ns),
        "usable": frame.detections is not None,
        "ids": found.ids,
        "families": found.families,
        "corners_px": found.corners_px.ravel(),
        "sigma_px": found.sigma_px.ravel(),
        "refined": found.refined,
        "faults": frame.faults,
    }


def _recordable(stamp_ns: int) -> int:
    """`Stamps` refuses a stamp outside of the range; it refuses the clamped one too."""
    return min(max(stamp_ns, _LEAST_NS), _MOST_NS)


# --- outcomes ---


@dataclass(frozen=True)
class Column:
    """How one field of an outcome is written, read and compared.

    A field that older drives lack has a default, is not reported, and is not compared.

    Attributes:
        kind: type of its value in a message.
        of: its value of the pilot's outcome; None is left out of the message.
        dtype: of the column; None: a tuple with one value for each outcome.
        shape: of one value; with zeros: any that is the same in the whole drive.
        default: value of a message without the field; `...`: every message has it.
        missing: value in the column where the message's is None.
        is_reported: it belongs to the report, which an outcome has as a whole or not at all.
        slack: how far off a replay may be, in tolerances; None: it is not compared.
    """

    kind: Any
    of: Callable[[Outcome], Any]
    dtype: type | None = None
    shape: tuple[int, ...] = ()
    default: Any = ...
    missing: Any = None
    is_reported: bool = False
    slack: float | None = None

    def row(self, outcome: Outcome) -> Any:
        """The value of the pilot's outcome, as a row of the column has it."""
        value = self.of(outcome)
        return np.full(self.shape, self.missing) if value is None else value

    def column(
        self, values: Sequence[Any], where: str
    ) -> Shaped[np.ndarray, "..."] | tuple[Any, ...]:
        """The column of the messages' values.

        Raises:
            BadInput: names `where` if they differ in size.
        """
        if self.dtype is None:
            return tuple(self.missing if value is None else value for value in values)
        shape, missing = self.shape, self.missing
        if shape:
            shapes = {value.shape for value in values if value is not None}
            if len(shapes) > 1:
                raise BadInput(where, f"differ in size: {sorted(size for size, *_ in shapes)}")
            shape = shapes.pop() if shapes else shape
            missing = np.full(shape, missing)
        filled = [missing if value is None else value for value in values]
        return np.array(filled, self.dtype).reshape(len(filled), *shape)


_Of = str | Callable[[Outcome], Any]  # a path of attributes, or a function


def _column(kind: Any, of: _Of, dtype: type | None = None, **more: Any) -> Column:
    return Column(kind, operator.attrgetter(of) if isinstance(of, str) else of, dtype, **more)


_reported = partial(_column, default=None, is_reported=True)
_number = partial(_reported, Real, dtype=float, missing=np.nan)
_index = partial(_reported, Index, dtype=int, missing=-1)
_flag = partial(_column, Flag, dtype=bool, default=False, is_reported=True, slack=0)
_newer = partial(_column, default=None, missing=np.nan)  # older drives have none


def _array(kind: Any, of: _Of, shape: tuple[int, ...]) -> Column:
    return _reported(kind, of, float, shape=shape, missing=np.nan, slack=1)


def _rows(of: _Of, *row: int) -> Column:
    """Any number of rows, which differ from outcome to outcome."""
    kind = Annotated[np.ndarray, Array(shape=(-1, *row))]
    return _reported(kind, of, missing=np.zeros((0, *row)))


def _named(kind: Any, name: str) -> Column:
    return _column(kind, lambda one: list(getattr(one, name)) or None, default=[], missing=[])


def _errors(one: Outcome) -> np.ndarray:
    return errors_of(one.belief.bank)[0]


def _sigma(one: Outcome) -> np.ndarray:
    return errors_of(one.belief.bank)[1]


def _hypotheses(one: Outcome) -> np.ndarray:
    bank = one.belief.bank
    return np.asarray(planar_in_world(planar_poses(bank)[0][bank.initialised], one.origin_m))


def _log_weight(one: Outcome) -> np.ndarray:
    return np.asarray(one.belief.bank.log_weight[one.belief.bank.initialised])


def _Ts_vehicle_world(one: Outcome) -> np.ndarray:
    candidates = one.output.candidates
    Ts = np.asarray(candidates.T_vehicle_world.wxyz_xyz)[candidates.valid]
    return np.asarray(inverses_in_world(Ts, one.origin_m))


def _costs(one: Outcome) -> np.ndarray:
    return np.asarray(one.output.costs[one.output.candidates.valid])


def _selected(one: Outcome) -> int:
    selected = int(one.output.selected)
    return int(np.sum(one.output.candidates.valid[:selected])) if selected >= 0 else -1


def _share(one: Outcome) -> float | None:
    return repeated_share(one.belief)


def _twist(one: Outcome) -> np.ndarray | None:
    return None if one.twist is None else np.array(one.twist, float)


_Ints = Int[np.ndarray, " N"]
_Reals = Float[np.ndarray, " N"]
_Bools = Bool[np.ndarray, " N"]
_NUMBERS = Annotated[np.ndarray, Array()]
_THREE = Annotated[np.ndarray, Array(shape=(3,))]
_SQUARE = Annotated[np.ndarray, Array(), AfterValidator(_square)]
_HEALTH, _REJECTS = Annotated[Health, _words(Health)], Annotated[Reject, _words(Reject)]


@dataclass(frozen=True)
class Outcomes:
    """N outcomes, one row each; all poses are in the world. NaN, an empty array or -1 where there
    was no report.

    Attributes:
        now_ns, stamp_ns: (N,), time of each outcome, timestamp of the data that was fused.
        health, faults, rejects: (N,), values of `Health`, `Fault` and `Reject`.
        steering_rad, throttle: (N,), the command, within the limits; 0 of a base that is no car.
        restarts, reason: how many so far, and the reason of the last one.
        digest: of the pilot's state, to compare a replay with; "" where none was taken.
        pose: (N, 3), x_m y_m psi_rad.
        covariance: (N, d, d).
        hypotheses, log_weight: N arrays, (K, 3) and (K,), of the hypotheses alive.
        Ts_vehicle_world, costs: N arrays, (M, 7) wxyz_xyz and (M,), of the valid candidates.
        selected: (N,) int, index of the selected candidate.
        errors, errors_sigma: (N, e), of sensors, cameras and gyro, see `jaxnav.recordings.learnt`;
            older drives have none.
        outvoted: N lists, ids of markers that others have voted against; older drives have none.
        outvoted_cameras: N lists, names of cameras that were left out; older drives have none.
        repeated_share: (N,), of the corners' variance that repeats; NaN in older drives.
        twist: (N, 3), the command forward_mps, left_mps, turn_radps, within the limits; NaN of a
            car.
    """

    now_ns: Annotated[_Ints, _column(Now, "now_ns", np.int64)]
    stamp_ns: Annotated[_Ints, _column(Stamp, "stamp_ns", np.int64, default=None, missing=-1)]
    health: Annotated[_Ints, _column(_HEALTH, "health", int, slack=0)]
    faults: Annotated[_Ints, _column(Faults, "faults", int, slack=0)]
    rejects: Annotated[_Ints, _column(_REJECTS, "rejects", int, slack=0)]
    steering_rad: Annotated[_Reals, _column(Real, "steering_rad", float, slack=1)]
    throttle: Annotated[_Reals, _column(Real, "throttle", float, slack=1)]
    restarts: Annotated[_Ints, _column(Count, "restarts", int, slack=0)]
    reason: Annotated[tuple[str, ...], _column(Word, "restart_reason")]
    digest: Annotated[tuple[str, ...], _column(Word, lambda one: "")]
    pose: Annotated[Float[np.ndarray, "N 3"], _array(_THREE, "pose", (3,))]
    covariance: Annotated[Float[np.ndarray, "N d d"], _array(_SQUARE, "output.covariance", (0, 0))]
    located: Annotated[_Bools, _flag("output.located")]
    decided: Annotated[_Bools, _flag("output.decided")]
    done: Annotated[_Bools, _flag("output.done")]
    flip_probability: Annotated[_Reals, _number("output.flip_probability", slack=1)]
    nis: Annotated[_Reals, _number("output.nis", slack=_NIS_SLACK)]
    hypothesis: Annotated[_Ints, _index("output.hypothesis")]
    hypotheses: Annotated[tuple[Float[np.ndarray, "K 3"], ...], _rows(_hypotheses, 3)]
    log_weight: Annotated[tuple[Float[np.ndarray, " K"], ...], _rows(_log_weight)]
    Ts_vehicle_world: Annotated[tuple[Float[np.ndarray, "M 7"], ...], _rows(_Ts_vehicle_world, 7)]
    costs: Annotated[tuple[Float[np.ndarray, " M"], ...], _rows(_costs)]
    selected: Annotated[_Ints, _index(_selected)]
    errors: Annotated[Float[np.ndarray, "N e"], _newer(_NUMBERS, _errors, float, shape=(0,))]
    errors_sigma: Annotated[Float[np.ndarray, "N e"], _newer(_NUMBERS, _sigma, float, shape=(0,))]
    outvoted: Annotated[tuple[list[int], ...], _named(list[Count], "outvoted")]
    outvoted_cameras: Annotated[tuple[list[str], ...], _named(list[Word], "outvoted_cameras")]
    repeated_share: Annotated[_Reals, _newer(Real, _share, float)]
    twist: Annotated[Float[np.ndarray, "N 3"], _newer(_THREE, _twist, float, shape=(3,), slack=1)]

    @cached_property
    def times_s(self) -> Float[np.ndarray, " N"]:
        """Time since the first outcome, (N,)."""
        return np.asarray((self.now_ns - self.now_ns[:1]) / 1e9)

    @staticmethod
    def from_values(values: Mapping[str, Sequence[Any]], where: str) -> "Outcomes":
        """The table of the values of N messages.

        Args:
            values: name of a field -> its N values.
            where: what a message about them begins with.

        Raises:
            BadInput: covariances differ in size.
        """
        columns: dict[str, Any] = {
            name: column.column(values[name], f"{where}.{name}") for name, column in COLUMNS.items()
        }
        return Outcomes(**columns)

    @staticmethod
    def from_outcome(outcome: Outcome) -> "Outcomes":
        """The table of one outcome, as if it had been recorded, without a digest."""
        values = {name: [column.of(outcome)] for name, column in COLUMNS.items()}
        return Outcomes.from_values(values, "outcome")


COLUMNS: dict[str, Column] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(Outcomes, include_extras=True).items()
}
REPORTED = [name for name, one in COLUMNS.items() if one.is_reported and one.default is None]


class OutcomeMessage(Entry):
    """An `Outcome` and its report: a row of `Outcomes`, with None for what is missing."""

    @model_validator(mode="after")
    def _is_whole(self) -> "OutcomeMessage":
        columns = vars(self)
        missing = sum(columns[name] is None for name in REPORTED)
        if 0 < missing < len(REPORTED):
            raise ValueError(f"must have all of {', '.join(REPORTED)}, or none")
        return self


_FIELDS: dict[str, Any] = {
    name: (one.kind | None if one.default is None else one.kind, one.default)
    for name, one in COLUMNS.items()
}


def outcome_message(outcome: Outcome) -> dict[str, Any]:
    """The message of an outcome.

    Args:
        outcome: with NumPy leaves in its output.
    """
    message = {}
    for name, column in COLUMNS.items():
        if (value := column.of(outcome)) is not None:
            message[name] = value.ravel() if isinstance(value, np.ndarray) and value.ndim else value
    return message | {"digest": digest(outcome)}


def digest(outcome: Outcome) -> str:
    """The digest of an outcome's belief and command: drives with the same digests are the same."""
    output = outcome.output
    numbers = (outcome.belief, output.pose, output.covariance, output.command)
    state = hashlib.blake2b(digest_size=8)
    for leaf in jax.tree.leaves(numbers):
        state.update(leaf.tobytes())
    command = outcome.command
    state.update(struct.pack(f"<{len(command)}d", *command))
    return state.hexdigest()


# --- images, and all schemas ---


class TimeMessage(Entry):
    """A time as Foxglove has it."""

    sec: Count
    nsec: Annotated[int, Field(strict=True, ge=0, lt=10**9)]


class ImageMessage(Entry):
    """A compressed image as Foxglove has it."""

    timestamp: TimeMessage
    frame_id: Word
    data: Base64
    format: Word


# topic -> the name of its schema and its model
MESSAGES: dict[str, tuple[str, type[TickMessage | OutcomeMessage]]] = {
    ODOMETRY: ("jaxnav.Odometry", OdometryMessage),
    TWIST: ("jaxnav.Twist", TwistMessage),
    FRAMES: ("jaxnav.Frames", FramesMessage),
    TICK: ("jaxnav.Tick", TickMessage),
    OUTCOME: ("jaxnav.Outcome", create_model("OutcomeMessage", __base__=OutcomeMessage, **_FIELDS)),
}
_KEPT = (
    *("type", "enum", "contentEncoding", "minimum", "exclusiveMaximum", "items", "minItems"),
    *("properties", "additionalProperties"),
)


def json_schema(model: type[BaseModel]) -> bytes:
    """The JSON schema of a model's messages as `encode` writes them, in the form that Foxglove
    reads: every type is one word, and there are no references."""
    schema = model.model_json_schema()
    return json.dumps(_simple(schema, schema.get("$defs", {}))).encode()


def _simple(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in schema:
        return _simple(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in schema:  # or null: then it is left out
        return _simple(schema["anyOf"][0], definitions)
    simple = {key: schema[key] for key in _KEPT if key in schema}
    if "items" in simple:
        simple["items"] = _simple(simple["items"], definitions)
    if "properties" in simple:
        fields = {key: _simple(inner, definitions) for key, inner in simple["properties"].items()}
        movable = [
            key for key, field in fields.items()
            if "number" in (field["type"], field.get("items", {}).get("type"))
        ]  # fmt: skip
        if movable:
            fields[NOT_FINITE] = {"type": "object", "properties": {}}
        simple["properties"] = fields
        simple["required"] = [key for key in schema.get("required", ()) if key not in movable]
    return simple
