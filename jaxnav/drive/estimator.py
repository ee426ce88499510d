"""Run the filter for the loop: one compiled call per event, with a history of recent events."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxnav.core.filter.estimate import Belief, Evidence
from jaxnav.core.models.imu import Gyro
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.core.navigator import Navigator, Output
from jaxnav.core.timeline import Corners, Events, advance
from jaxnav.drive.compiled_step import compile_or_load
from jaxnav.drive.history import EventData, History, HistoryEntry
from jaxnav.drive.packing import Packed, PackedLayout

EVENTS = 64  # fused by one call: 800 ms of odometry at 50 Hz and of frames at 30 Hz

_NOTHING = EventData()

# (belief, control, events, numbers) -> (belief, then, control, output), see `advance_packed`
Program = Callable[..., tuple[Packed, Packed, Packed, Packed]]
MeanRate = Callable[[int, int], float]  # of the interval between two times, ns


def advance_packed(
    navigator: Navigator, belief: Packed, control: Packed, events: Packed, numbers: Int[Array, "4"]
) -> tuple[Packed, Packed, Packed, Packed]:
    """`advance` with its arguments and results packed into a few vectors.

    Args:
        numbers: count, new, now_us, elapsed_us.
    """
    given = (part.unpack() for part in (belief, control, events))
    returned = advance(navigator, *given, *numbers)
    belief, then, control, output = (PackedLayout.from_tree(part).pack(part) for part in returned)
    return belief, then, control, output


def _beginning(navigator: Navigator) -> tuple[Packed, Packed]:
    """The belief and control state at the start of a drive."""
    state = navigator.init()
    belief, control = (PackedLayout.from_tree(it).pack(it) for it in (state.belief, state.control))
    return belief, control


@dataclass(frozen=True)
class FusionResult:
    """The result of one event. The leaves of `output` and `belief` are NumPy arrays."""

    output: Output
    belief: Belief
    refused: bool  # the event is older than all that is kept


class Estimator:
    """The estimator of one drive. The same calls give the same bits."""

    def __init__(
        self,
        navigator: Navigator,
        program: Program | None = None,
        mean_radps: MeanRate | None = None,
    ):
        """Args:
        navigator: the navigator to run.
        mean_radps: what a gyro tells of the interval between two times, NaN where it tells nothing;
            of a motion whose vehicle has a gyro.
        program: compiled `advance_packed` of the navigator; by default compiled by `jax.jit`, see
            `compile_or_load`.
        """
        self._program = program or compile_or_load(advance_packed, navigator, None)
        self._first, self._control = compile_or_load(_beginning, navigator, None)()
        self._layouts = {seeing: _layout(navigator, seeing) for seeing in (False, True)}
        self._mean_radps = mean_radps or (lambda begin_ns, end_ns: np.nan)
        # The last reading's values; those of another base are not commanded by.
        self._odometry: tuple[float, ...] = (np.nan, np.nan)
        self.reset()

    def reset(self) -> None:
        """Forget all sensor data; keep the progress on the route."""
        self._history: History | None = None
        self._belief = self._first
        self._belief_ns = 0

    def forget_speed(self) -> None:
        """Command as if the speed had never been known: the last reading was wrong."""
        self._odometry = (np.nan, *self._odometry[1:])

    def warm_up(self) -> None:
        """Compile, once for events with corners and once for those without."""
        for seeing in (False, True):
            numbers = np.zeros(4, np.int32)
            self._program(self._first, self._control, self._events([], 0, 0, seeing), numbers)

    def fuse(
        self, data: EventData | None, stamp_ns: int, now_ns: int, elapsed_ns: int
    ) -> FusionResult:
        """Fuse an event, or only predict to the present.

        Args:
            data: the event's data; None to predict only.
            stamp_ns: timestamp of the event.
            now_ns: time of the returned pose and command.
            elapsed_ns: time since the last command.
        """
        if data is not None and data.odometry is not None:
            self._odometry = data.odometry
        placed = None
        if data is not None:
            if self._history is None:
                self._history = History(self._first, stamp_ns)
            placed = self._history.place(stamp_ns, data)
        if placed is None:
            base_ns = self._belief_ns if self._history is not None else now_ns
            belief, _, output = self._call(self._belief, [], base_ns, 0, now_ns, elapsed_ns)
            believed = belief.fetch().unpack()
            return FusionResult(output.fetch().unpack(), believed, data is not None)
        base, entries = placed
        assert self._history is not None
        new = next(index for index, entry in enumerate(entries) if entry.data is data)
        belief, then, known = self._fused(base, entries, new, now_ns, elapsed_ns)
        self._belief, self._belief_ns = belief, entries[-1].stamp_ns
        self._history.store(belief, entries[new], then)
        return FusionResult(known, belief.fetch().unpack(), False)

    def _fused(
        self,
        base: HistoryEntry,
        entries: list[HistoryEntry],
        new: int,
        now_ns: int,
        elapsed_ns: int,
    ) -> tuple[Packed, Packed, Output]:
        """The belief after all entries, the belief after the new one, and the output. Takes one
        call nearly always, several where a frame is late and the cameras are many."""
        assert base.belief is not None
        rows = [(entry.stamp_ns, entry.data or _NOTHING) for entry in entries]
        belief, base_ns = base.belief, base.stamp_ns
        if len(rows) <= EVENTS:
            belief, then, output = self._call(belief, rows, base_ns, new, now_ns, elapsed_ns)
            return belief, then, output.fetch().unpack()
        # One less: the free place is the value of `new` where the new event is in another part.
        size, control = EVENTS - 1, self._control
        for first in range(0, len(rows), size):
            part, holds = rows[first : first + size], first <= new < first + size
            self._control = control  # there is one command
            index = new - first if holds else size
            belief, after, output = self._call(belief, part, base_ns, index, now_ns, elapsed_ns)
            base_ns = part[-1][0]
            if holds:
                then, of_new = after, output
        # What the new event said stands in the output of its own part.
        completed: Output = eqx.tree_at(
            lambda output: [getattr(output, field.name) for field in fields(Evidence)],
            output.fetch().unpack(),
            [getattr(of_new.fetch().unpack(), field.name) for field in fields(Evidence)],
        )
        return belief, then, completed

    def _call(
        self,
        belief: Packed,
        rows: Sequence[tuple[int, EventData]],
        base_ns: int,
        new: int,
        now_ns: int,
        elapsed_ns: int,
    ) -> tuple[Packed, Packed, Packed]:
        seeing = any(data.corners_px is not None for _, data in rows)
        events = self._events(rows, base_ns, now_ns, seeing)
        now_us, elapsed_us = _us_between(base_ns, now_ns), elapsed_ns // 1000
        numbers = np.array([len(rows), new, _int32(now_us), _int32(elapsed_us)], np.int32)
        belief, then, self._control, output = self._program(belief, self._control, events, numbers)
        return belief, then, output

    def _events(
        self, rows: Sequence[tuple[int, EventData]], base_ns: int, now_ns: int, seeing: bool
    ) -> Packed:
        packed, events = self._layouts[seeing].room()
        # Numbers that float32 can't hold become infinite, and the filter leaves them out.
        with np.errstate(over="ignore"):
            self._fill(events, rows, base_ns)
            if vars(events)["gyro_radps"] is not None:
                stamps_ns = [base_ns, *(stamp_ns for stamp_ns, _ in rows), now_ns]
                rates = [self._mean_radps(*pair) for pair in pairwise(stamps_ns)]
                vars(events)["gyro_radps"][: len(rows)] = rates[:-1]
                vars(events)["gyro_since_radps"][...] = rates[-1]
        return packed

    def _fill(self, events: Events, rows: Sequence[tuple[int, EventData]], base_ns: int) -> None:
        into = vars(events)  # reading an attribute of an equinox module takes 1 us
        twists, speed_mps, steering_rad = into["twists"], into["speed_mps"], into["steering_rad"]
        if twists is None:
            speed_mps[:], steering_rad[:] = self._odometry
        for index, (stamp_ns, data) in enumerate(rows):
            into["stamps_us"][index] = _int32(_us_between(base_ns, stamp_ns))
            if data.odometry is not None:
                if twists is None:
                    speed_mps[index], steering_rad[index] = data.odometry
                else:
                    twists[index] = data.odometry
                into["has_odometry"][index] = True
            if data.corners_px is not None:
                corners = vars(into["corners"])
                corners["corners_px"][index] = data.corners_px
                corners["visible"][index] = data.visible
                corners["corner_sigma_px"][index] = data.sigma_px


def gyro_of(navigator: Navigator) -> Gyro | None:
    """The gyro that a navigator's filter reads; None: its vehicle has none, or it looks at none."""
    vehicle = getattr(navigator.motion, "vehicle", None)
    return None if vehicle is None else vehicle.gyro


def _layout(navigator: Navigator, seeing: bool) -> PackedLayout:
    """The layout of `EVENTS` events, with or without room for corners."""
    lanes = EVENTS, len(navigator.rig), len(navigator.markers.ids)
    dtype = navigator.corner_sigma_px.dtype
    vehicle = getattr(navigator.motion, "vehicle", None)
    turns = gyro_of(navigator) is not None

    def events() -> Events:
        corners = Corners(
            corners_px=jnp.zeros((*lanes, 4, 2), dtype),
            visible=jnp.zeros(lanes, bool),
            corner_sigma_px=jnp.zeros((*lanes, 4), dtype),
        )
        return Events(
            stamps_us=jnp.zeros(EVENTS, jnp.int32),
            speed_mps=jnp.zeros(EVENTS, dtype),
            steering_rad=jnp.zeros(EVENTS, dtype),
            has_odometry=jnp.zeros(EVENTS, bool),
            corners=corners if seeing else None,
            twists=jnp.zeros((EVENTS, 3), dtype) if isinstance(vehicle, TwistBase) else None,
            gyro_radps=jnp.zeros(EVENTS, dtype) if turns else None,
            gyro_since_radps=jnp.zeros((), dtype) if turns else None,
        )

    return PackedLayout.from_tree(jax.eval_shape(events))


def _us_between(earlier_ns: int, later_ns: int) -> int:
    """Time difference, us, of rounded times: differences add up, whatever event they start at."""
    return later_ns // 1000 - earlier_ns // 1000


def _int32(number: int) -> int:
    """Clamp to [0, 2^31 - 1]: as us that is over half an hour, in which nothing came."""
    return min(max(number, 0), 2**31 - 1)
