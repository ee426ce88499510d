"""The rows of the fault matrix, with the requirements of each."""

import dataclasses
import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault, Health, Reject
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input
from jaxnav.sim.bases import BASES
from jaxnav.vehicles.conformance import injections as inject
from jaxnav.vehicles.conformance.faults import ALL_CAMERAS, BEGIN_S, FaultRow, Happens
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, Change, Rates
from jaxnav.vehicles.world import SimWorld

Make = Callable[[], Change]

_LATEST = np.inf  # to the end of the drive
_SLOW = Health.DEGRADED
_BEGIN_NS = BEGIN_NS + int(BEGIN_S * 1e9)
# Largest difference of a corner between a search near its expected place and one everywhere.
_JITTER_PX = 0.01

# Rows by the worst health that they must lead to, and, for the first two, by the usual error.
_may_slow = partial(FaultRow, health=(Health.OK, _SLOW), error_m=0.15)
_slows = partial(FaultRow, health=(_SLOW, _SLOW), error_m=0.08)
_may_stop = partial(FaultRow, health=(Health.OK, Health.STOP))
_stops = partial(FaultRow, health=(Health.STOP, Health.STOP))


def matrix() -> list[FaultRow]:
    """All rows of the matrix."""
    return [
        FaultRow("none", bases=BASES),
        *_cameras(),
        *_frames(),
        *_stamps(),
        *_odometry(),
        *_calibration_and_world(),
        *_contradicted_files(),
        *_standstill(),
        *_nonsense(),
        *_spoofed(),
        *_maps(),
        *_actuators(),
        *_gyros(),
        # Frames taken earlier than their stamps, which no clock shows: this must be reported, but
        # the estimate's error meanwhile is not limited.
        _may_slow(
            "frames 50 ms late, unsaid, all",
            _stamped(lambda ns: ns + int(0.05 * 1e9)),
            Fault.CAMERA_LATE,
            error_m=np.inf,
            begins_s=0.0,
            ends_s=_LATEST,
            drive_s=10.0,
            rates=Rates(frame_delay_s=0.03 + 0.05),
        ),
    ]


def _framed(edit: inject.EditFrame) -> Make:
    return lambda: inject.frames(edit)


def _cornered(edit: Callable[[np.ndarray], np.ndarray]) -> Make:
    return _framed(inject.corners(edit))


def _stamped(edit: Callable[[int], int]) -> Make:
    return _framed(inject.stamps(edit))


def _frozen(cameras: range, jitter_px: float = _JITTER_PX) -> Make:
    return lambda: inject.frames(inject.frozen(cameras, jitter_px))


def _speed(edit: Callable[[float], float]) -> Make:
    return lambda: inject.odometry(inject.speed(edit))


def _cameras() -> list[FaultRow]:
    def out(camera: int) -> FaultRow:
        change = _framed(inject.only_camera(camera, inject.gone))
        return _may_slow(f"camera {camera} out", change, Fault.CAMERA_STALE, error_m=0.10)

    def blind(name: str, duration_s: float) -> FaultRow:
        images = name == "tunnel"
        costs = Health.STOP if duration_s >= 5 else _SLOW if duration_s > 2 else Health.OK
        flag = Fault.NO_MARKER if images else Fault.CAMERAS_STALE
        return FaultRow(
            f"{name}, {duration_s:g} s",
            _framed(inject.nothing_seen if images else inject.gone),
            flag if duration_s > (1.0 if images else 0.2) else Fault(0),
            health=(costs, max(costs, Health.DEAD_RECKONING if images else _SLOW)),
            error_m=0.05 + 0.06 * min(duration_s, 5.0),
            ends_s=BEGIN_S + duration_s,
            drive_s=BEGIN_S + duration_s + 3,
        )

    pairs = itertools.product((0.2, 1.0, 5.0, 20.0), ("all cameras out", "tunnel"))
    return [out(0), out(2), *(blind(name, duration_s) for duration_s, name in pairs)]


def _frames() -> list[FaultRow]:
    def renamed(detections: Detections) -> Detections:
        return dataclasses.replace(detections, ids=detections.ids + 7)

    def doubled(shift_px: float) -> Make:
        def edit(detections: Detections) -> Detections:
            other = dataclasses.replace(detections, corners_px=detections.corners_px + shift_px)
            return Detections.concatenate([detections, other])

        return _framed(inject.detections(edit))

    def mirrored(c: np.ndarray) -> np.ndarray:
        center = c.mean(axis=1, keepdims=True)
        return np.stack([2 * center[..., 0] - c[..., 0], c[..., 1]], axis=-1)[:, [1, 0, 3, 2]]

    def turned(c: np.ndarray) -> np.ndarray:
        return np.roll(c, 1, axis=1)

    briefly = partial(_may_slow, error_m=0.10, ends_s=BEGIN_S + 0.17)
    return [
        _may_slow("None or wrong-size frames", _framed(inject.unusable), Fault.FRAME_UNUSABLE),
        _may_slow("frozen images, new stamps", _frozen(ALL_CAMERAS, 0.0), Fault.FRAME_FROZEN),
        _may_slow("NaN in corners", _cornered(lambda c: c * np.nan), Fault.CORNERS_NOT_FINITE),
        _may_slow("inf in corners", _cornered(lambda c: c + np.inf), Fault.CORNERS_NOT_FINITE),
        _may_slow("unknown id", _framed(inject.detections(renamed)), Fault.UNKNOWN_MARKER),
        _may_slow("two markers of one id", doubled(60.0), Fault.DUPLICATE_MARKER),
        FaultRow("duplicate detection", doubled(0.0)),
        briefly("mirrored corners, 5 frames", _cornered(mirrored)),
        briefly("corners turned by 90 deg, 5 frames", _cornered(turned), rejects=Reject.INNOVATION),
    ]


def _stamps() -> list[FaultRow]:
    def drifting(ns: int) -> int:
        return ns + int((ns - BEGIN_NS) * 100e-6)

    def drifting_odometry(reading: Odometry) -> Odometry:
        return dataclasses.replace(reading, stamp_ns=drifting(reading.stamp_ns))

    def drift() -> Change:
        return inject.both(_stamped(drifting)(), inject.odometry(drifting_odometry))

    refused = partial(_may_slow, faults=Fault.STAMP_INVALID)
    late = partial(_may_slow, error_m=0.05)
    lasts = partial(FaultRow, begins_s=2.0, ends_s=_LATEST)
    return [
        refused("stamps jump by +1 s", _stamped(lambda ns: ns + int(1.0 * 1e9))),
        refused("stamps jump by -1 s", _stamped(lambda ns: ns + int(-1.0 * 1e9))),
        FaultRow("frames 50 ms late, each other", lambda: inject.late(0.05, 2)),
        late("frames 500 ms late, each third", lambda: inject.late(0.5, 3)),
        refused("equal stamps", _stamped(lambda ns: BEGIN_NS + 1)),
        refused("zero stamps", _stamped(lambda ns: 0)),
        refused("negative stamps", _stamped(lambda ns: -5)),
        lasts("clocks that drift by 100 ppm", drift, always=True),
        lasts("cameras skewed by 30 ms", rates=Rates(camera_skew_s=0.03)),
    ]


def _odometry() -> list[FaultRow]:
    def spikes() -> Change:
        calls = itertools.count(1)
        return inject.odometry(inject.speed(lambda mps: (1.0 if next(calls) % 5 else 10.0) * mps))

    def wrapped(mps: float) -> float:
        # The wrap of 2^32 counts, each 1 / 15 000 m, in 20 ms.
        return mps - 2**32 / 15e3 / 0.02

    def read(edit: Callable[[], inject.EditOdometry]) -> Make:
        return lambda: inject.odometry(edit())

    def invalid(reading: Odometry) -> Odometry:
        return dataclasses.replace(reading, valid=False)

    def without(given: Input) -> list[Input]:
        return [dataclasses.replace(given, odometry=None, frames=())]

    off = partial(_may_slow, error_m=0.08)
    return [
        FaultRow("odometry x10, each fifth", spikes, rejects=Reject.ODOMETRY),
        off("odometry of the other sign", _speed(lambda mps: -mps), rejects=Reject.ODOMETRY),
        off("odometry 30 % off", _speed(lambda mps: 1.3 * mps)),
        off("odometry stuck", read(inject.repeated), Fault.ODOMETRY_STUCK),
        _slows("odometry invalid", read(lambda: invalid), Fault.ODOMETRY_INVALID),
        _slows("odometry out", read(lambda: inject.gone), Fault.ODOMETRY_STALE),
        FaultRow(
            "odometry wraps around",
            _speed(wrapped),
            Fault.ODOMETRY_INVALID,
            ends_s=BEGIN_S + 0.03,
        ),
        off("NaN and inf in odometry", read(inject.not_finite), Fault.ODOMETRY_INVALID),
        _stops("blind and without odometry", lambda: without, Fault.CAMERAS_STALE, error_m=0.30),
    ]


def _at(times_ns: range, act: Callable[[SimWorld], None]) -> Callable[[], Happens]:
    """Act on the world at these times."""

    def made() -> Happens:
        due_ns = list(times_ns)

        def happens(now_ns: int, world: SimWorld) -> None:
            if due_ns and now_ns >= due_ns[0]:
                del due_ns[0]
                act(world)

        return happens

    return made


_once = partial(_at, range(_BEGIN_NS, _BEGIN_NS + 1))


def _focal(by: float) -> Callable[[CameraRig], CameraRig]:
    """A file whose focal lengths are so many times the true ones."""
    return lambda rig: eqx.tree_at(lambda r: r.cameras.focal_px, rig, by * rig.cameras.focal_px)


def _swapped(*order: int) -> Callable[[CameraRig], CameraRig]:
    """A file that gives each camera the place of another one."""

    def told(rig: CameraRig) -> CameraRig:
        swapped = rig.Ts_camera_vehicle.wxyz_xyz[np.array(order)]
        return eqx.tree_at(lambda r: r.Ts_camera_vehicle.wxyz_xyz, rig, swapped)

    return told


def _moved(xi: Callable[[int], np.ndarray]) -> Callable[[CameraRig], CameraRig]:
    """A file that moves every camera of C by xi, (C, 6) or (6,), in the vehicle's axes."""

    def told(rig: CameraRig) -> CameraRig:
        Ts = rig.Ts_camera_vehicle
        by = np.broadcast_to(xi(len(rig)), (len(rig), 6))
        moved = Ts @ jaxlie.SE3.exp(jnp.asarray(by, Ts.wxyz_xyz.dtype))
        return eqx.tree_at(lambda r: r.Ts_camera_vehicle, rig, moved)

    return told


def _off_by_hand(cameras: int) -> np.ndarray:
    """1 cm and 1 deg, in any direction."""
    directions = np.random.default_rng(0).standard_normal((cameras, 2, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    return np.concatenate([0.01 * directions[:, 0], np.deg2rad(1.0) * directions[:, 1]], axis=1)


_misplaced = _moved(_off_by_hand)


_FROM_THE_START = range(BEGIN_NS, BEGIN_NS + 1)


def _contradicted_files() -> list[FaultRow]:
    """Rows in which a file, or a copy, contradicts what the vehicle sees from the start."""

    def sized(by: float) -> Callable[[MarkerMap], MarkerMap]:
        return lambda markers: eqx.tree_at(lambda m: m.size_m, markers, by * markers.size_m)

    lasting = partial(FaultRow, begins_s=0.0, ends_s=_LATEST, bases=BASES[:2])
    never = partial(lasting, health=(Health.INIT,) * 2, lied_m=0.0, named_m=0.01, drive_s=2.0)
    told = partial(
        lasting,
        # Where two cameras see the marker, they contradict each other first.
        faults=Fault.FILES_CONTRADICTED | Fault.DUPLICATE_MARKER,
        health=(_SLOW, Health.STOP),
        error_m=np.inf,
        drive_s=8.0,
    )
    soon = partial(told, lied_m=0.7, named_m=0.7, stood_m=1.5)
    turned = partial(told, lied_m=0.3, named_m=0.8, stood_m=1.3)  # a base turns on the spot first
    return [
        never(
            "corners listed the other way round",
            _cornered(lambda c: c[:, ::-1]),
            Fault.CORNERS_MIRRORED,
        ),
        never(
            "a copy that another camera sees",
            happens=_at(_FROM_THE_START, lambda world: world.copy_markers((2.0, -1.6, np.pi))),
            faults=Fault.DUPLICATE_MARKER,
        ),
        *(soon(f"marker size x{by:g}", mapped=sized(by)) for by in (2.0, 0.5)),
        *(
            told(f"marker size x{by:g}", mapped=sized(by), lied_m=1.0, named_m=1.5)
            for by in (1.2, 0.8)
        ),
        *(soon(f"focal length x{by:g}", telling=_focal(by)) for by in (1.5, 0.7)),
        turned("front and rear camera swapped", telling=_swapped(2, 1, 0, 3)),
        turned(
            "rig turned by 180 deg",
            telling=_moved(lambda _: np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi])),
        ),
    ]


def _calibration_and_world() -> list[FaultRow]:
    wrong = partial(_may_slow, begins_s=2.0, ends_s=_LATEST, drive_s=6.0)

    def stall(stall_s: float) -> FaultRow:
        return FaultRow(
            f"the loop stalls for {stall_s * 1e3:.0f} ms",
            partial(inject.stalled, BEGIN_S + stall_s),
            Fault.CLOCK_JUMPED if stall_s > 1 else Fault(0),
            health=(Health.OK, _SLOW if stall_s < 1 else Health.STOP),
            error_m=0.15,
            ends_s=BEGIN_S + stall_s,
        )

    def knocked(by_deg: float, **more: Any) -> FaultRow:
        turn_rad = (0.0, float(np.deg2rad(by_deg)), 0.0)
        return _may_slow(
            f"camera 1 knocked by {by_deg:g} deg",
            happens=_once(lambda world: world.knock_camera(1, turn_rad)),
            error_m=0.05,
            ends_s=_LATEST,
            drive_s=14.0,  # through the view of the three next cameras
            **more,
        )

    return [
        wrong("cameras off by 1 deg, 1 cm", telling=_misplaced),
        wrong("focal length off by 2 %", telling=_focal(1.02)),
        _may_stop(
            "cameras swapped",
            telling=_swapped(0, 3, 2, 1),
            # One that shares its view with another is outvoted; one that is alone looks right.
            faults=Fault.CAMERA_OUTVOTED | Fault.RESTARTED,
            error_m=np.inf,
            begins_s=2.0,
            ends_s=_LATEST,
            drive_s=12.0,  # to a side camera's view
        ),
        knocked(8.0),
        knocked(30.0, faults=Fault.CAMERA_OUTVOTED),
        _may_slow(
            "marker moved by 5 cm",
            happens=_once(lambda world: world.move_markers((0.05, 0.0, 0.0))),
            error_after_m=0.10,
            ends_s=BEGIN_S + 0.1,
        ),
        _may_stop(
            "kidnapped: 1 m, 90 deg",
            happens=_once(lambda world: world.carry_off((-0.7, -0.7, np.pi / 2))),
            faults=Fault.RESTARTED,
            rejects=Reject.INNOVATION,
            error_m=1.2,
            error_after_m=0.10,
            ends_s=BEGIN_S + 0.1,
            well=_SLOW,  # for a metre
        ),
        *map(stall, (0.05, 0.5, 1.5)),
    ]


def _standstill() -> list[FaultRow]:
    """Rows in which something stands still while others move, or rates matter."""

    def all_of_it() -> Change:
        return inject.both(_frozen(ALL_CAMERAS)(), inject.odometry(inject.repeated()))

    def held(now_ns: int, world: SimWorld) -> None:
        world.hold(now_ns >= _BEGIN_NS)

    def to_and_fro() -> Happens:
        side = itertools.cycle((1.0, -1.0))
        times_ns = range(_BEGIN_NS, _BEGIN_NS + 7 * 10**9, 7 * 10**8)
        return _at(times_ns, lambda world: world.move_markers((next(side), 0.0, 0.0)))()

    stopped = _speed(lambda mps: 0.0)
    stuck = partial(_slows, faults=Fault.ODOMETRY_STUCK)
    return [
        _may_slow("frozen images, found anew", _frozen(ALL_CAMERAS), Fault.FRAME_FROZEN),
        _may_slow("one camera frozen, found anew", _frozen(range(1)), Fault.FRAME_FROZEN),
        _stops(
            "frozen images for 9 s",
            _frozen(ALL_CAMERAS),
            Fault.FRAME_FROZEN,
            error_m=0.35,
            ends_s=BEGIN_S + 9.0,
            drive_s=BEGIN_S + 12.0,
        ),
        stuck("odometry stuck at 0", stopped, error_m=0.10),
        stuck("odometry at 0 from the start", stopped, error_m=0.20, begins_s=0.0),
        _may_slow(
            "odometry stuck, steering not",
            lambda: _speed(inject.constant())(),
            Fault.ODOMETRY_STUCK,
            error_m=0.10,
            ends_s=BEGIN_S + 4.0,
            drive_s=BEGIN_S + 7.0,
        ),
        _stops(
            "cameras and odometry frozen",
            all_of_it,
            Fault.NOTHING_MOVES | Fault.ODOMETRY_STALE,
            error_m=0.8,
            # The car has gone farther than the frozen odometer explains: RELOCATED, and slow.
            well=_SLOW,
            ends_s=BEGIN_S + 4.0,
            drive_s=BEGIN_S + 7.0,
        ),
        _stops(
            "the car is held fast",
            happens=lambda: held,
            faults=Fault.NOTHING_MOVES,
            error_m=0.15,
            ends_s=_LATEST,
        ),
        FaultRow(
            "frames 150 ms late, odometry at 500 Hz",
            rates=Rates(odometry_period_s=0.002, frame_delay_s=0.15),
            begins_s=2.0,
            ends_s=_LATEST,
            drive_s=4.0,
        ),
        _stops(
            "a marker to and fro for 7 s",
            happens=to_and_fro,
            faults=Fault.RESTARTED_OFTEN,
            error_m=1.5,
            ends_s=_LATEST,
            drive_s=BEGIN_S + 7.0,
        ),
    ]


def _nonsense() -> list[FaultRow]:
    def anywhere() -> Change:
        rng = np.random.default_rng(0)
        return _cornered(lambda c: rng.uniform([0, 0], [820, 410], c.shape))()

    def blind(by: float) -> Make:
        """Hide all markers, and scale the measured speed."""
        dark, scaled = _framed(inject.nothing_seen), _speed(lambda mps: by * mps)
        return lambda: inject.both(dark(), scaled())

    doubted = partial(_stops, faults=Fault.ODOMETRY_DOUBTFUL, error_m=0.10)
    return [
        _slows("corners at random places", anywhere, rejects=Reject.INNOVATION, error_m=0.05),
        _may_stop(
            "corners at random places from the start",
            anywhere,
            rejects=Reject.INNOVATION,
            begins_s=0.0,
            ends_s=_LATEST,
        ),
        doubted("odometry 0 without a marker", blind(0.0)),
        doubted("odometry x3 without a marker", blind(3.0)),
    ]


def _spoofed() -> list[FaultRow]:
    def dragged(by_mps: float) -> Callable[[], Happens]:
        def made() -> Happens:
            last_ns = _BEGIN_NS

            def happens(now_ns: int, world: SimWorld) -> None:
                nonlocal last_ns
                if now_ns > last_ns:
                    world.move_markers((by_mps * (now_ns - last_ns) / 1e9, 0.0, 0.0))
                    last_ns = now_ns

            return happens

        return made

    moved = _once(lambda world: world.move_markers((1.0, 0.0, 0.0)))
    larger = _once(lambda world: world.move_markers((0.0, 0.0, 0.0), scale=1.5))
    copied = partial(FaultRow, ends_s=_LATEST, drive_s=8.0)
    slow, stopped = (_SLOW, Health.STOP), (Health.STOP, Health.STOP)
    relocated = partial(copied, faults=Fault.RELOCATED)
    return [
        # A copy of the only marker can't be told from it: a slow and reported reaction is required.
        relocated("a copy 1 m away instead", happens=moved, health=slow, error_m=1.1),
        relocated("a larger copy instead", happens=larger, health=slow, error_m=1.1),
        relocated(
            "a copy 1 m away instead, not to relocate",
            happens=moved,
            health=stopped,
            error_m=0.10,
            relocate=False,
        ),
        copied(
            "a copy dragged at 0.1 m/s",
            happens=dragged(0.1),
            faults=Fault.WAYS_DISPUTED,
            health=slow,
            error_m=0.6,
        ),
        # Restart follows restart, and none of them is confirmed: the car stands.
        copied(
            "a copy dragged at 0.5 m/s",
            happens=dragged(0.5),
            faults=Fault.RESTARTED,
            health=(Health.OK, Health.STOP),
            error_m=0.3,
        ),
    ]


def _maps() -> list[FaultRow]:
    def three(markers: MarkerMap) -> MarkerMap:
        """The marker, with one more on either side."""
        Ts = np.repeat(np.asarray(markers.Ts_world_marker.wxyz_xyz)[:1], 3, axis=0)
        Ts[:, 4] += np.array([0.0, -0.5, 0.5], Ts.dtype)
        return MarkerMap(
            jaxlie.SE3(jnp.asarray(Ts)),
            jnp.repeat(markers.size_m[:1], 3),
            tuple(range(3)),
            markers.families[:1] * 3,
        )

    return [
        _may_slow(
            "one of three markers moved",
            happens=_once(lambda world: world.move_markers((0.3, 0.0, 0.0), slice(2, 3))),
            markers=three,
            faults=Fault.MARKER_OUTVOTED,
            error_m=0.05,
            ends_s=_LATEST,
        ),
        # Maps so far away that float32 resolves only 0.5 m or 1 m there; nothing else is wrong.
        FaultRow("map 10 000 km from the origin", shift_m=(1e7, -1e7, 0.0)),
        FaultRow("map at UTM coordinates", shift_m=(448_251.37, 5_411_932.81, 0.0)),
    ]


_Numbers = tuple[float, ...]


def _signed(*signs: float) -> Callable[[_Numbers], _Numbers]:
    """Multiply each number of a command or of a reading."""
    return lambda numbers: tuple(sign * n for sign, n in zip(signs, numbers, strict=True))


def _actuators() -> list[FaultRow]:
    """Rows in which a command moves the vehicle otherwise than it says.

    Each with an odometer that tells the truth, from some time on, and from the start with one that
    tells what was commanded: it is wired in the same way, or there is none on that part. Such an
    odometer also makes the filter restart, which may stop the vehicle before the part is named.

    The way that is allowed holds half a metre on which the part is used; before it lie 0.35 m that
    are straight, and from the start 0.75 m that the pose is undecided on and 0.35 m more.
    """
    driven = partial(
        FaultRow, error_m=np.inf, error_after_m=np.inf, health=(Health.STOP, Health.STOP),
        ends_s=_LATEST, lied_m=0.1, drive_s=8.0,
    )  # fmt: skip

    def wired(
        name: str,
        faults: Fault,
        acts: Callable[[_Numbers], _Numbers],
        tells: Callable[..., _Numbers],
        bases: tuple[str, ...],
    ) -> list[FaultRow]:
        return [
            driven(
                f"{name}, true odometer",
                happens=_once(lambda world: world.rewire(acts)),
                faults=faults,
                bases=bases,
                named_m=0.85,
                slow_m=0.85,
                stood_m=1.35,
            ),
            driven(
                f"{name}, odometer as told, from the start",
                happens=_at(_FROM_THE_START, lambda world: world.rewire(acts, tells)),
                faults=faults | Fault.RESTARTED_OFTEN,
                begins_s=0.0,
                bases=bases,
                named_m=1.6,
                slow_m=1.6,
                stood_m=2.1,
            ),
        ]

    def like(acts: Callable[[_Numbers], _Numbers]) -> Callable[..., _Numbers]:
        """An odometer that is wired as the motors are."""
        return lambda read, command: acts(read)

    def swapped(numbers: _Numbers) -> _Numbers:
        return numbers[1], numbers[0], numbers[2]

    def steered(read: _Numbers, command: _Numbers) -> _Numbers:
        return read[0], command[0]

    def stuck_at(steering_rad: float) -> Callable[[_Numbers], _Numbers]:
        return lambda command: (steering_rad, command[1])

    def unsigned(read: _Numbers, command: _Numbers) -> _Numbers:
        return abs(read[0]), read[1]

    car, bases = ("ackermann",), BASES[1:]
    drive, left, turn = (
        Fault.DRIVE_CONTRADICTED, Fault.SIDEWAYS_CONTRADICTED, Fault.TURN_CONTRADICTED
    )  # fmt: skip
    ahead, aside, around = _signed(-1, 1, 1), _signed(1, -1, 1), _signed(1, 1, -1)
    return [
        *wired("steering reversed", turn, _signed(-1, 1), steered, car),
        *wired("servo dead at 0", turn, stuck_at(0.0), steered, car),
        *wired("servo dead at 0.3 rad", turn, stuck_at(0.3), steered, car),
        *wired("motor reversed", drive, _signed(1, -1), unsigned, car),
        *wired("ahead reversed", drive, ahead, like(ahead), bases),
        *wired("left reversed", left, aside, like(aside), ("omni",)),
        *wired("turn reversed", turn, around, like(around), ("differential",)),
        *wired("ahead and left swapped", drive | left, swapped, like(swapped), ("omni",)),
    ]


def _gyros() -> list[FaultRow]:
    """Rows in which a gyro lies from the start, with four seconds in which no marker is seen."""

    def lies(name: str, edit: Callable[[], Callable[[float], float]]) -> FaultRow:
        def dark() -> Change:
            blind = inject.frames(inject.nothing_seen)
            return inject.both(inject.gyro(edit()), inject.between(5.0, 9.0, blind))

        return FaultRow(
            name, dark, Fault.GYRO_CONTRADICTED | Fault.GYRO_INVALID,
            health=(Health.OK, Health.STOP), error_m=0.3,
            begins_s=0.0, ends_s=_LATEST, bases=BASES[:2], gyro=True, lied_m=0.0, named_m=1.5,
            drive_s=12.0,
        )  # fmt: skip

    def noisy() -> Callable[[float], float]:
        rng = np.random.default_rng(0)
        return lambda rate_radps: rate_radps + float(rng.standard_normal())

    return [
        lies("a gyro stuck at 0", lambda: lambda rate_radps: 0.0),
        lies("a gyro of the wrong sign", lambda: lambda rate_radps: -rate_radps),
        lies("a gyro in degrees", lambda: np.rad2deg),
        lies("a gyro with 1 rad/s of noise", noisy),
    ]
