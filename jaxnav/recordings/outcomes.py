"""The fields of a recorded outcome, each in one place: the lines of `Outcomes`.

A line says how its field is written, read, and compared with that of a replay. The message, its
JSON schema, and the table of a whole drive are made of these lines. A field that older drives lack
has a default, does not belong to the report, and is not compared.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from operator import attrgetter
from typing import Annotated, Any, get_type_hints

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from pydantic import AfterValidator, create_model, model_validator

from jaxnav.core.filter.planar import planar_poses
from jaxnav.core.models.origin import inverses_in_world, planar_in_world
from jaxnav.drive.flags import Health, Reject
from jaxnav.drive.pilot import Outcome
from jaxnav.errors import BadInput
from jaxnav.files.validation import Count, Entry
from jaxnav.recordings.learnt import error_sigmas, errors_at, repeated_share
from jaxnav.recordings.message_fields import (
    Array,
    Faults,
    Flag,
    Index,
    Now,
    Real,
    Rows,
    Stamp,
    Word,
    Words,
    square,
)

_NIS_SLACK = 1e3  # NIS is in units of sigma, which is a millimetre


@dataclass(frozen=True)
class Column:
    """How one field of an outcome is written, read and compared.

    Attributes:
        kind: type of its value in a message.
        of: its value of the pilot's outcome, as `encode` takes it; None is left out.
        dtype: of the column; None: a tuple with one value for each outcome.
        shape: of one value; with zeros: any that is the same in the whole drive.
        default: value of a message without the field; `...`: every message has it.
        missing: value in the column where the message's is None.
        is_reported: it belongs to the report, which an outcome has as a whole or not at all.
        slack: how far off a replay may be, in tolerances; None: it is not compared.
    """

    kind: Any
    of: Callable[[Outcome], Any]
    dtype: type | None
    shape: tuple[int, ...] = ()
    default: Any = ...
    missing: Any = None
    is_reported: bool = False
    slack: float | None = None

    def value(self, outcome: Outcome) -> Any:
        """The value of the pilot's outcome, as a message that was read has it."""
        value = self.of(outcome)
        return value.values if isinstance(value, Rows) else value

    def compared(self, outcome: Outcome) -> Any:
        """The value of the pilot's outcome, as a row of the column has it."""
        value = self.value(outcome)
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


def _at(path: str) -> Callable[[Outcome], Any]:
    first, *rest = path.split(".")
    own = attrgetter(first)
    if not rest:
        return own

    def of(outcome: Outcome) -> Any:
        value = own(outcome)
        for name in rest:
            value = vars(value)[name]  # reading an attribute of an equinox module takes 1 us
        return value

    return of


def _field(kind: Any, of: _Of, dtype: type | None, **more: Any) -> Column:
    return Column(kind, _at(of) if isinstance(of, str) else of, dtype, **more)


_reported = partial(_field, default=None, is_reported=True)
_number = partial(_reported, Real, dtype=float, missing=np.nan)
_index = partial(_reported, Index, dtype=int, missing=-1)
_flag = partial(_field, Flag, dtype=bool, default=False, is_reported=True, slack=0)


def _array(shape: tuple[int, ...], of: _Of, kind: Any = None) -> Column:
    kind = kind or Annotated[np.ndarray, Array("number", shape)]
    return _reported(kind, of, float, shape=shape, missing=np.nan, slack=1)


def _ragged(row: tuple[int, ...], of: _Of) -> Column:
    kind = Annotated[np.ndarray, Array("number", (-1, *row))]
    return _reported(kind, of, None, missing=np.zeros((0, *row)))


def _of_sensors(of: _Of) -> Column:
    kind = Annotated[np.ndarray, Array("number")]
    return _field(kind, of, float, shape=(0,), default=None, missing=np.nan)


_initialised, _valid = _at("belief.bank.initialised"), _at("output.candidates.valid")
_candidates, _slot = _at("output.candidates.T_vehicle_world.wxyz_xyz"), _at("output.selected")
_covariance, _log_weight = _at("output.covariance"), _at("belief.bank.log_weight")
_costs, _bank, _pose = _at("output.costs"), _at("belief.bank"), _at("output.pose")


def _world_pose(one: Outcome) -> Rows:
    return Rows(_pose(one), made=partial(planar_in_world, origin_m=one.origin_m))


def _errors(one: Outcome) -> Rows:
    return Rows(_bank(one).mean, errors_at(_bank(one)))


def _errors_sigma(one: Outcome) -> Rows:
    slot, _ = errors_at(_bank(one))
    return Rows(_bank(one).covariance, slot, error_sigmas)


def _hypotheses(one: Outcome) -> Rows:
    in_world = partial(planar_in_world, origin_m=one.origin_m)
    return Rows(planar_poses(_bank(one))[0], _initialised(one), in_world)


def _Ts_vehicle_world(one: Outcome) -> Rows:
    in_world = partial(inverses_in_world, origin_m=one.origin_m)
    return Rows(_candidates(one), _valid(one), in_world)


def _selected(one: Outcome) -> int:
    selected = int(_slot(one))
    return sum(_valid(one)[:selected].tolist()) if selected >= 0 else -1


def _twist(one: Outcome) -> Float[np.ndarray, " 3"] | None:
    return None if one.twist is None else np.array(one.twist, float)


_HEALTH, _REJECTS = Annotated[Health, Words(Health)], Annotated[Reject, Words(Reject)]
_SQUARE = Annotated[np.ndarray, Array("number"), AfterValidator(square)]


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

    now_ns: Annotated[Int[np.ndarray, " N"], _field(Now, "now_ns", np.int64)]
    stamp_ns: Annotated[
        Int[np.ndarray, " N"], _field(Stamp, "stamp_ns", np.int64, default=None, missing=-1)
    ]
    health: Annotated[Int[np.ndarray, " N"], _field(_HEALTH, "health", int, slack=0)]
    faults: Annotated[Int[np.ndarray, " N"], _field(Faults, "faults", int, slack=0)]
    rejects: Annotated[Int[np.ndarray, " N"], _field(_REJECTS, "rejects", int, slack=0)]
    steering_rad: Annotated[Float[np.ndarray, " N"], _field(Real, "steering_rad", float, slack=1)]
    throttle: Annotated[Float[np.ndarray, " N"], _field(Real, "throttle", float, slack=1)]
    restarts: Annotated[Int[np.ndarray, " N"], _field(Count, "restarts", int, slack=0)]
    reason: Annotated[tuple[str, ...], _field(Word, "restart_reason", None)]
    digest: Annotated[tuple[str, ...], _field(Word, lambda one: "", None)]
    pose: Annotated[Float[np.ndarray, "N 3"], _array((3,), _world_pose)]
    covariance: Annotated[
        Float[np.ndarray, "N d d"],
        _array((0, 0), lambda one: Rows(_covariance(one)), _SQUARE),
    ]
    located: Annotated[Bool[np.ndarray, " N"], _flag("output.located")]
    decided: Annotated[Bool[np.ndarray, " N"], _flag("output.decided")]
    done: Annotated[Bool[np.ndarray, " N"], _flag("output.done")]
    flip_probability: Annotated[
        Float[np.ndarray, " N"], _number("output.flip_probability", slack=1)
    ]
    nis: Annotated[Float[np.ndarray, " N"], _number("output.nis", slack=_NIS_SLACK)]
    hypothesis: Annotated[Int[np.ndarray, " N"], _index("output.hypothesis")]
    hypotheses: Annotated[tuple[Float[np.ndarray, "K 3"], ...], _ragged((3,), _hypotheses)]
    log_weight: Annotated[
        tuple[Float[np.ndarray, " K"], ...],
        _ragged((), lambda one: Rows(_log_weight(one), _initialised(one))),
    ]
    Ts_vehicle_world: Annotated[
        tuple[Float[np.ndarray, "M 7"], ...], _ragged((7,), _Ts_vehicle_world)
    ]
    costs: Annotated[
        tuple[Float[np.ndarray, " M"], ...],
        _ragged((), lambda one: Rows(_costs(one), _valid(one))),
    ]
    selected: Annotated[Int[np.ndarray, " N"], _index(_selected)]
    errors: Annotated[Float[np.ndarray, "N e"], _of_sensors(_errors)]
    errors_sigma: Annotated[Float[np.ndarray, "N e"], _of_sensors(_errors_sigma)]
    outvoted: Annotated[
        tuple[list[int], ...],
        _field(list[Count], lambda one: list(one.outvoted) or None, None, default=[], missing=[]),
    ]
    outvoted_cameras: Annotated[
        tuple[list[str], ...],
        _field(
            list[Word], lambda one: list(one.outvoted_cameras) or None, None, default=[], missing=[]
        ),
    ]
    repeated_share: Annotated[
        Float[np.ndarray, " N"],
        _field(Real, lambda one: repeated_share(one.belief), float, default=None, missing=np.nan),
    ]
    twist: Annotated[
        Float[np.ndarray, "N 3"],
        _field(
            Annotated[np.ndarray, Array("number", (3,))], _twist, float,
            shape=(3,), default=None, missing=np.nan, slack=1,
        ),
    ]  # fmt: skip

    @cached_property
    def times_s(self) -> Float[np.ndarray, " N"]:
        """Time since the first outcome, (N,)."""
        return np.asarray((self.now_ns - self.now_ns[:1]) / 1e9)

    @staticmethod
    def of_values(values: Mapping[str, Sequence[Any]], where: str) -> "Outcomes":
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
    def of(outcome: Outcome) -> "Outcomes":
        """The table of one outcome, as if it had been recorded, without a digest."""
        values = {name: [column.value(outcome)] for name, column in COLUMNS.items()}
        return Outcomes.of_values(values, "outcome")


COLUMNS: dict[str, Column] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(Outcomes, include_extras=True).items()
}
REPORTED = [name for name, one in COLUMNS.items() if one.is_reported and one.default is None]
# The order in a message: what all have, what older drives lack, the report.
_WRITTEN = [
    (name, one.of)
    for name, one in sorted(
        COLUMNS.items(), key=lambda item: (item[1].default is not ..., item[1].is_reported)
    )
]


class OutcomeMessage(Entry):
    """An `Outcome` and its report: a row of `Outcomes`, with None for what is missing."""

    @model_validator(mode="after")
    def _is_whole(self) -> "OutcomeMessage":
        columns = vars(self)
        missing = sum(columns[name] is None for name in REPORTED)
        if 0 < missing < len(REPORTED):
            raise ValueError(f"must have all of {', '.join(REPORTED)}, or none")
        return self


def _kind(column: Column) -> Any:
    return column.kind | None if column.default is None else column.kind


_FIELDS: dict[str, Any] = {name: (_kind(one), one.default) for name, one in COLUMNS.items()}
OUTCOME_MESSAGE = create_model("OutcomeMessage", __base__=OutcomeMessage, **_FIELDS)


def outcome_message(outcome: Outcome, digest: str = "") -> dict[str, Any]:
    """The message of an outcome.

    Args:
        outcome: with NumPy leaves in its output.
        digest: digest of the pilot's state, to compare a replay with.
    """
    message = {}
    for name, of in _WRITTEN:
        if (value := of(outcome)) is not None:
            message[name] = value
    message["digest"] = digest
    return message
