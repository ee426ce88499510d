"""The filter as the loop calls it: one compiled program, and the history of what it was told."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.control import ControlState
from jaxnav.navigator import Navigator
from jaxnav.runtime.compiled import compiled
from jaxnav.runtime.history import EVENTS, History, Told
from jaxnav.timeline import Events, Moment, Report, advance, begin

_NOTHING = Told()


# (moment, control, events, count, new, now_us, elapsed_us) -> (moment, then, control, report)
Program = Callable[..., tuple[Moment, Moment, ControlState | None, Report]]


@dataclass(frozen=True)
class Fused:
    """What came of an event. Leaves of `report` and `moment` are NumPy's."""

    report: Report
    moment: Moment
    refused: bool  # older than all that is kept
    events: int  # that were fused, this one and those after it


class Estimator:
    """One drive. The same calls give the same bits."""

    def __init__(self, navigator: Navigator, program: Program | None = None):
        """Args:
        navigator: what to run.
        program: `advance` of the navigator, compiled; by default by `jax.jit`, see `compiled`.
        """
        self._navigator = navigator
        self._program = program or compiled(advance, navigator, None)
        self._first = begin(navigator)
        self._blank = _blank(navigator)
        self._odometry = (np.nan, np.nan)  # speed_mps, steering_rad: the last
        self.reset()
        self._control = navigator.init().control

    def reset(self) -> None:
        """Forget what was sensed; the route goes on."""
        self._history: History | None = None
        self._moment: Moment = self._first
        self._moment_ns = 0

    def warm_up(self) -> None:
        """Compile, and leave no trace of it."""
        self._call(self._first, [], 0, 0, 0, 0)

    def fuse(self, told: Told | None, stamp_ns: int, now_ns: int, elapsed_ns: int) -> Fused:
        """Take an event in, or none.

        Args:
            told: None to look at the clock only.
            stamp_ns: when it was true.
            now_ns: for which the pose and the command are meant.
            elapsed_ns: since the last command.
        """
        if told is not None and told.odometry is not None:
            self._odometry = told.odometry
        placed = None
        if told is not None:
            if self._history is None:
                self._history = History(self._first, stamp_ns)
            placed = self._history.place(stamp_ns, told)
        if placed is None:
            base_ns = self._moment_ns if self._history is not None else now_ns
            result = self._call(self._moment, [], base_ns, 0, now_ns, elapsed_ns)
            return self._kept(result, told is not None, 0)
        base, entries = placed
        assert base.moment is not None
        assert self._history is not None
        new = next(index for index, entry in enumerate(entries) if entry.told is told)
        rows = [(entry.stamp_ns, entry.told or _NOTHING) for entry in entries]
        result = self._call(base.moment, rows, base.stamp_ns, new, now_ns, elapsed_ns)
        self._moment, self._moment_ns = result[0], entries[-1].stamp_ns
        self._history.fused(self._moment, entries[new], result[1])
        return self._kept(result, False, len(entries))

    def _kept(self, result: tuple[Any, ...], refused: bool, events: int) -> Fused:
        moment, _, self._control, report = result
        report, moment = jax.tree.map(np.asarray, (report, moment))
        return Fused(report, moment, refused, events)

    def _call(
        self,
        moment: Moment,
        rows: Sequence[tuple[int, Told]],
        base_ns: int,
        new: int,
        now_ns: int,
        elapsed_ns: int,
    ) -> tuple[Any, ...]:
        events = self._events(rows, base_ns)
        numbers = (len(rows), new, _us_between(base_ns, now_ns), elapsed_ns // 1000)
        scalars = [_int32(number) for number in numbers]
        return self._program(moment, self._control, events, *scalars)

    def _events(self, rows: Sequence[tuple[int, Told]], base_ns: int) -> Events:
        events: Events = jax.tree.map(np.copy, self._blank)
        # What float32 can't hold is infinite, and so left out by the filter.
        with np.errstate(over="ignore"):
            self._fill(events, rows, base_ns)
        return events

    def _fill(self, into: Any, rows: Sequence[tuple[int, Told]], base_ns: int) -> None:
        into.speed_mps[:], into.steering_rad[:] = self._odometry
        for index, (stamp_ns, told) in enumerate(rows):
            into.stamps_us[index] = _int32(_us_between(base_ns, stamp_ns))
            if told.odometry is not None:
                into.speed_mps[index], into.steering_rad[index] = told.odometry
                into.has_odometry[index] = True
            if told.corners_px is not None:
                into.corners_px[index] = told.corners_px
                into.visible[index] = told.visible
                into.corner_sigma_px[index] = told.sigma_px


def _blank(navigator: Navigator) -> Events:
    """Room for `EVENTS`; of NumPy's arrays, which JAX takes as its own."""
    lanes = EVENTS, len(navigator.rig), len(navigator.markers.ids)
    dtype = navigator.corner_sigma_px.dtype
    events = Events(
        stamps_us=jnp.zeros(EVENTS, jnp.int32),
        corners_px=jnp.zeros((*lanes, 4, 2), dtype),
        visible=jnp.zeros(lanes, bool),
        corner_sigma_px=jnp.ones((*lanes, 4), dtype),
        speed_mps=jnp.zeros(EVENTS, dtype),
        steering_rad=jnp.zeros(EVENTS, dtype),
        has_odometry=jnp.zeros(EVENTS, bool),
    )
    blank: Events = jax.tree.map(np.asarray, events)
    return blank


def _us_between(earlier_ns: int, later_ns: int) -> int:
    """So that times add up, whichever events they are measured from."""
    return later_ns // 1000 - earlier_ns // 1000


def _int32(number: int) -> np.int32:
    """Inside of what it can be: half an hour, in us, within which nothing came."""
    return np.int32(min(max(number, 0), 2**31 - 1))
