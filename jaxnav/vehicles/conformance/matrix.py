"""The fault matrix: what goes wrong on a drive, and what the drive must come to."""

import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.drive.flags import Fault, Health, Reject
from jaxnav.sim.bases import BASES
from jaxnav.vehicles.conformance import injections as inject
from jaxnav.vehicles.conformance.faults import ALL_CAMERAS, BEGIN_S, FaultRow, Happens
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, Change, Rates
from jaxnav.vehicles.world import SimWorld

Make = Callable[[], Change]
Numbers = tuple[float, ...]

_ENDLESS = math.inf  # to the end of the drive
_BEGIN_NS = BEGIN_NS + int(BEGIN_S * 1e9)
_FROM_START = range(BEGIN_NS, BEGIN_NS + 1)
# Largest difference of a corner between a search near its expected place and one everywhere.
_JITTER_PX = 0.01
OK, RECKONING, SLOW, STOP = Health.OK, Health.DEAD_RECKONING, Health.DEGRADED, Health.STOP


# What happens to the data on their way, made anew for each drive.


def _frames(edit: inject.EditFrame) -> Make:
    return lambda: inject.frames(edit)


def _corners(edit: Callable[[np.ndarray], np.ndarray]) -> Make:
    return _frames(inject.corners(edit))


def _stamps(edit: Callable[[int], int]) -> Make:
    return _frames(inject.field("stamp_ns", edit))


def _frozen(cameras: range, jitter_px: float = _JITTER_PX) -> Make:
    return lambda: inject.frames(inject.frozen(cameras, jitter_px))


def _speed(edit: Callable[[float], float]) -> Make:
    return lambda: inject.odometry(inject.speed(edit))


def _reading(edit: Callable[[], inject.EditOdometry]) -> Make:
    return lambda: inject.odometry(edit())


def _both(one: Make, other: Make) -> Make:
    return lambda: inject.both(one(), other())


_DARK, _LOST = _frames(inject.nothing_seen), _frames(inject.gone)


# What happens in the world, made anew for each drive.


def _at(times_ns: range, act: Callable[[SimWorld], object]) -> Callable[[], Happens]:
    def made() -> Happens:
        due_ns = list(times_ns)

        def happens(now_ns: int, world: SimWorld) -> None:
            if due_ns and now_ns >= due_ns[0]:
                del due_ns[0]
                act(world)

        return happens

    return made


_once = partial(_at, range(_BEGIN_NS, _BEGIN_NS + 1))


def _hold(now_ns: int, world: SimWorld) -> None:
    world.hold(now_ns >= _BEGIN_NS)


def _to_and_fro() -> Happens:
    side = itertools.cycle((1.0, -1.0))
    times_ns = range(_BEGIN_NS, _BEGIN_NS + 7 * 10**9, 7 * 10**8)
    return _at(times_ns, lambda world: world.move_markers((next(side), 0.0, 0.0)))()


def _dragged(by_mps: float) -> Callable[[], Happens]:
    def made() -> Happens:
        last_ns = _BEGIN_NS

        def happens(now_ns: int, world: SimWorld) -> None:
            nonlocal last_ns
            if now_ns > last_ns:
                world.move_markers((by_mps * (now_ns - last_ns) / 1e9, 0.0, 0.0))
                last_ns = now_ns

        return happens

    return made


# What the files say of the true rig and map.


def _sized(by: float) -> Callable[[MarkerMap], MarkerMap]:
    return lambda markers: eqx.tree_at(lambda m: m.size_m, markers, by * markers.size_m)


def _focal(by: float) -> Callable[[CameraRig], CameraRig]:
    return lambda rig: eqx.tree_at(lambda r: r.cameras.focal_px, rig, by * rig.cameras.focal_px)


def _swapped(*order: int) -> Callable[[CameraRig], CameraRig]:
    """Each camera in the place of another one."""

    def poses(rig: CameraRig) -> jax.Array:
        return rig.Ts_camera_vehicle.wxyz_xyz

    return lambda rig: eqx.tree_at(poses, rig, poses(rig)[np.array(order)])


def _moved(xi: Callable[[int], np.ndarray]) -> Callable[[CameraRig], CameraRig]:
    """Every camera of C moved by xi(C), (C, 6) or (6,), in the vehicle's axes."""

    def moved(rig: CameraRig) -> CameraRig:
        Ts = rig.Ts_camera_vehicle
        by = np.broadcast_to(xi(len(rig)), (len(rig), 6))
        Ts = Ts @ jaxlie.SE3.exp(jnp.asarray(by, Ts.wxyz_xyz.dtype))
        return eqx.tree_at(lambda r: r.Ts_camera_vehicle, rig, Ts)

    return moved


def _off_by_hand(cameras: int) -> np.ndarray:
    """1 cm and 1 deg, in any direction."""
    directions = np.random.default_rng(0).standard_normal((cameras, 2, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    return np.concatenate([0.01 * directions[:, 0], np.deg2rad(1.0) * directions[:, 1]], axis=1)


def _three(markers: MarkerMap) -> MarkerMap:
    """The marker, with one more on either side."""
    Ts = np.repeat(np.asarray(markers.Ts_world_marker.wxyz_xyz)[:1], 3, axis=0)
    Ts[:, 4] += np.array([0.0, -0.5, 0.5], Ts.dtype)
    sizes_m = jnp.repeat(markers.size_m[:1], 3)
    return MarkerMap(jaxlie.SE3(jnp.asarray(Ts)), sizes_m, (0, 1, 2), markers.families[:1] * 3)


# Requirements that several rows share.

# By the worst health that they must lead to, and, for the first two, by the usual error.
_may_slow = partial(FaultRow, health=(OK, SLOW), error_m=0.15)
_slows = partial(FaultRow, health=(SLOW, SLOW), error_m=0.08)
_may_stop = partial(FaultRow, health=(OK, STOP))
_stops = partial(FaultRow, health=(STOP, STOP))
_lasts = partial(FaultRow, ends_s=_ENDLESS)
_briefly = partial(_may_slow, error_m=0.10, ends_s=BEGIN_S + 0.17)
_wrong_file = partial(_may_slow, begins_s=2.0, ends_s=_ENDLESS, drive_s=6.0)
# A file, or a copy, contradicts what the vehicle sees from the start.
_contradicted = partial(_lasts, begins_s=0.0, bases=BASES[:2])
_never_starts = partial(
    _contradicted, health=(Health.INIT,) * 2, lied_m=0.0, named_m=0.01, drive_s=2.0
)
_named = partial(
    _contradicted,
    # Where two cameras see the marker, they contradict each other first.
    faults=Fault.FILES_CONTRADICTED | Fault.DUPLICATE_MARKER,
    health=(SLOW, STOP),
    error_m=math.inf,
    drive_s=8.0,
)
_named_soon = partial(_named, lied_m=0.7, named_m=0.7, stood_m=1.5)
_named_turned = partial(_named, lied_m=0.3, named_m=0.8, stood_m=1.3)  # a base turns on the spot
# A copy of the only marker can't be told from it: a slow and reported reaction is required.
_copied = partial(_lasts, drive_s=8.0)
_relocated = partial(_copied, faults=Fault.RELOCATED, health=(SLOW, STOP), error_m=1.1)
_gyro_lies = partial(
    FaultRow, faults=Fault.GYRO_CONTRADICTED | Fault.GYRO_INVALID, health=(OK, STOP), error_m=0.3,
    begins_s=0.0, ends_s=_ENDLESS, bases=BASES[:2], gyro=True, lied_m=0.0, named_m=1.5,
    drive_s=12.0,
)  # fmt: skip


def _blind(name: str, duration_s: float, change: Make, faults: Fault, *health: Health) -> FaultRow:
    return FaultRow(
        f"{name}, {duration_s:g} s",
        change,
        faults,
        health=(health[0], health[-1]),
        error_m=0.05 + 0.06 * min(duration_s, 5.0),
        ends_s=BEGIN_S + duration_s,
        drive_s=BEGIN_S + duration_s + 3,
    )


def _stalls(duration_s: float, worst: Health, faults: Fault) -> FaultRow:
    end_s = BEGIN_S + duration_s
    name, change = f"the loop stalls for {duration_s * 1e3:.0f} ms", partial(inject.stalled, end_s)
    return FaultRow(name, change, faults, health=(OK, worst), error_m=0.15, ends_s=end_s)


def _knocked(by_deg: float, **more: Any) -> FaultRow:
    turn_rad = (0.0, float(np.deg2rad(by_deg)), 0.0)
    return _may_slow(
        f"camera 1 knocked by {by_deg:g} deg",
        happens=_once(lambda world: world.knock_camera(1, turn_rad)),
        error_m=0.05,
        ends_s=_ENDLESS,
        drive_s=14.0,  # through the view of the three next cameras
        **more,
    )


def _dark_gyro(edit: Callable[[], Callable[[float], float]]) -> Make:
    """A gyro that lies from the start, and four seconds in which no marker is seen."""
    dark = inject.between(5.0, 9.0, inject.frames(inject.nothing_seen))
    return lambda: inject.both(inject.gyro(edit()), dark)


def _wired(
    name: str,
    faults: Fault,
    acts: Callable[[Numbers], Numbers],
    reads: Callable[[Numbers, Numbers], Numbers] | None,
    *bases: str,
) -> list[FaultRow]:
    """Rows in which an actuator does something else than the command.

    In one the odometer is right and the fault comes later; in the other, from the start, it reads
    what was commanded: it is wired in the same way, or there is none on that part. Such an odometer
    also makes the filter restart, which may stop the vehicle before the part is named.

    The way that is allowed holds half a metre on which the part is used; before it lie 0.35 m that
    are straight, and from the start 0.75 m that the pose is undecided on and 0.35 m more.

    Args:
        acts: what acts in place of a command.
        reads: what is read (true reading, command); None: as the motors are wired.
    """
    row = partial(
        _lasts, error_m=math.inf, error_after_m=math.inf, health=(STOP, STOP), bases=bases,
        lied_m=0.1, drive_s=8.0,
    )  # fmt: skip
    later = partial(row, named_m=0.85, slow_m=0.85, stood_m=1.35)
    at_once = partial(row, named_m=1.6, slow_m=1.6, stood_m=2.1, begins_s=0.0)
    odometer = reads or (lambda read, command: acts(read))
    return [
        later(
            f"{name}, true odometer", happens=_once(lambda world: world.rewire(acts)), faults=faults
        ),
        at_once(
            f"{name}, odometer as told, from the start",
            happens=_at(_FROM_START, lambda world: world.rewire(acts, odometer)),
            faults=faults | Fault.RESTARTED_OFTEN,
        ),
    ]


def _signed(*signs: float) -> Callable[[Numbers], Numbers]:
    return lambda numbers: tuple(sign * n for sign, n in zip(signs, numbers, strict=True))


def _actuators() -> list[FaultRow]:
    def steered(read: Numbers, command: Numbers) -> Numbers:
        return read[0], command[0]

    def unsigned(read: Numbers, command: Numbers) -> Numbers:
        return abs(read[0]), read[1]

    def stuck_at(steering_rad: float) -> Callable[[Numbers], Numbers]:
        return lambda command: (steering_rad, command[1])

    def swapped(numbers: Numbers) -> Numbers:
        return numbers[1], numbers[0], numbers[2]

    drive, turn = Fault.DRIVE_CONTRADICTED, Fault.TURN_CONTRADICTED
    left = Fault.SIDEWAYS_CONTRADICTED
    car, omni, differential = "ackermann", "omni", "differential"
    return [
        *_wired("steering reversed", turn, _signed(-1, 1), steered, car),
        *_wired("servo dead at 0", turn, stuck_at(0.0), steered, car),
        *_wired("servo dead at 0.3 rad", turn, stuck_at(0.3), steered, car),
        *_wired("motor reversed", drive, _signed(1, -1), unsigned, car),
        *_wired("ahead reversed", drive, _signed(-1, 1, 1), None, *BASES[1:]),
        *_wired("left reversed", left, _signed(1, -1, 1), None, omni),
        *_wired("turn reversed", turn, _signed(1, 1, -1), None, differential),
        *_wired("ahead and left swapped", drive | left, swapped, None, omni),
    ]


MATRIX: tuple[FaultRow, ...] = (
    FaultRow("none", bases=BASES),
    # Cameras.
    *(
        _may_slow(
            f"camera {camera} out",
            _frames(inject.only_camera(camera, inject.gone)),
            Fault.CAMERA_STALE,
            error_m=0.10,
        )
        for camera in (0, 2)
    ),
    _blind("all cameras out", 0.2, _LOST, Fault(0), OK, SLOW),
    _blind("tunnel", 0.2, _DARK, Fault(0), OK, RECKONING),
    _blind("all cameras out", 1.0, _LOST, Fault.CAMERAS_STALE, OK, SLOW),
    _blind("tunnel", 1.0, _DARK, Fault(0), OK, RECKONING),
    _blind("all cameras out", 5.0, _LOST, Fault.CAMERAS_STALE, STOP),
    _blind("tunnel", 5.0, _DARK, Fault.NO_MARKER, STOP),
    _blind("all cameras out", 20.0, _LOST, Fault.CAMERAS_STALE, STOP),
    _blind("tunnel", 20.0, _DARK, Fault.NO_MARKER, STOP),
    # Frames.
    _may_slow("None or wrong-size frames", _frames(inject.unusable), Fault.FRAME_UNUSABLE),
    _may_slow("frozen images, new stamps", _frozen(ALL_CAMERAS, 0.0), Fault.FRAME_FROZEN),
    _may_slow("NaN in corners", _corners(lambda c: c * np.nan), Fault.CORNERS_NOT_FINITE),
    _may_slow("inf in corners", _corners(lambda c: c + np.inf), Fault.CORNERS_NOT_FINITE),
    _may_slow(
        "unknown id",
        _frames(inject.detections(inject.field("ids", lambda ids: ids + 7))),
        Fault.UNKNOWN_MARKER,
    ),
    _may_slow("two markers of one id", _frames(inject.doubled(60.0)), Fault.DUPLICATE_MARKER),
    FaultRow("duplicate detection", _frames(inject.doubled(0.0))),
    _briefly("mirrored corners, 5 frames", _corners(inject.mirrored)),
    _briefly(
        "corners turned by 90 deg, 5 frames",
        _corners(lambda c: np.roll(c, 1, axis=1)),
        rejects=Reject.INNOVATION,
    ),
    # Stamps.
    _may_slow("stamps jump by +1 s", _stamps(lambda ns: ns + 10**9), Fault.STAMP_INVALID),
    _may_slow("stamps jump by -1 s", _stamps(lambda ns: ns - 10**9), Fault.STAMP_INVALID),
    FaultRow("frames 50 ms late, each other", partial(inject.late, 0.05, 2)),
    _may_slow("frames 500 ms late, each third", partial(inject.late, 0.5, 3), error_m=0.05),
    _may_slow("equal stamps", _stamps(lambda ns: BEGIN_NS + 1), Fault.STAMP_INVALID),
    _may_slow("zero stamps", _stamps(lambda ns: 0), Fault.STAMP_INVALID),
    _may_slow("negative stamps", _stamps(lambda ns: -5), Fault.STAMP_INVALID),
    _lasts("clocks that drift by 100 ppm", inject.drifting_clocks, begins_s=2.0, always=True),
    _lasts("cameras skewed by 30 ms", rates=Rates(camera_skew_s=0.03), begins_s=2.0),
    # Odometry.
    FaultRow("odometry x10, each fifth", _reading(inject.spiking), rejects=Reject.ODOMETRY),
    _may_slow(
        "odometry of the other sign",
        _speed(lambda mps: -mps),
        rejects=Reject.ODOMETRY,
        error_m=0.08,
    ),
    _may_slow("odometry 30 % off", _speed(lambda mps: 1.3 * mps), error_m=0.08),
    _may_slow("odometry stuck", _reading(inject.repeated), Fault.ODOMETRY_STUCK, error_m=0.08),
    _slows("odometry invalid", _reading(lambda: inject.invalid), Fault.ODOMETRY_INVALID),
    _slows("odometry out", _reading(lambda: inject.gone), Fault.ODOMETRY_STALE),
    FaultRow(
        "odometry wraps around",
        # The wrap of 2^32 counts, each 1 / 15 000 m, in 20 ms.
        _speed(lambda mps: mps - 2**32 / 15e3 / 0.02),
        Fault.ODOMETRY_INVALID,
        ends_s=BEGIN_S + 0.03,
    ),
    _may_slow(
        "NaN and inf in odometry", _reading(inject.not_finite), Fault.ODOMETRY_INVALID, error_m=0.08
    ),
    _stops("blind and without odometry", lambda: inject.neither, Fault.CAMERAS_STALE, error_m=0.30),
    # Calibration and world.
    _wrong_file("cameras off by 1 deg, 1 cm", rig_file=_moved(_off_by_hand)),
    _wrong_file("focal length off by 2 %", rig_file=_focal(1.02)),
    _may_stop(
        "cameras swapped",
        rig_file=_swapped(0, 3, 2, 1),
        # One that shares its view with another is outvoted; one that is alone looks right.
        faults=Fault.CAMERA_OUTVOTED | Fault.RESTARTED,
        error_m=math.inf,
        begins_s=2.0,
        ends_s=_ENDLESS,
        drive_s=12.0,  # to a side camera's view
    ),
    _knocked(8.0),
    _knocked(30.0, faults=Fault.CAMERA_OUTVOTED),
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
        well=SLOW,  # for a metre
    ),
    _stalls(0.05, SLOW, Fault(0)),
    _stalls(0.5, SLOW, Fault(0)),
    _stalls(1.5, STOP, Fault.CLOCK_JUMPED),
    # Files, or copies, that what is seen contradicts from the start.
    _never_starts(
        "corners listed the other way round", _corners(lambda c: c[:, ::-1]), Fault.CORNERS_MIRRORED
    ),
    _never_starts(
        "a copy that another camera sees",
        happens=_at(_FROM_START, lambda world: world.copy_markers((2.0, -1.6, np.pi))),
        faults=Fault.DUPLICATE_MARKER,
    ),
    _named_soon("marker size x2", map_file=_sized(2.0)),
    _named_soon("marker size x0.5", map_file=_sized(0.5)),
    _named("marker size x1.2", map_file=_sized(1.2), lied_m=1.0, named_m=1.5),
    _named("marker size x0.8", map_file=_sized(0.8), lied_m=1.0, named_m=1.5),
    _named_soon("focal length x1.5", rig_file=_focal(1.5)),
    _named_soon("focal length x0.7", rig_file=_focal(0.7)),
    _named_turned("front and rear camera swapped", rig_file=_swapped(2, 1, 0, 3)),
    _named_turned(
        "rig turned by 180 deg", rig_file=_moved(lambda _: np.array([0, 0, 0, 0, 0, np.pi]))
    ),
    # Something stands still while others move, or rates matter.
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
    _slows("odometry stuck at 0", _speed(lambda mps: 0.0), Fault.ODOMETRY_STUCK, error_m=0.10),
    _slows(
        "odometry at 0 from the start",
        _speed(lambda mps: 0.0),
        Fault.ODOMETRY_STUCK,
        error_m=0.20,
        begins_s=0.0,
    ),
    _may_slow(
        "odometry stuck, steering not",
        _reading(lambda: inject.speed(inject.constant())),
        Fault.ODOMETRY_STUCK,
        error_m=0.10,
        ends_s=BEGIN_S + 4.0,
        drive_s=BEGIN_S + 7.0,
    ),
    _stops(
        "cameras and odometry frozen",
        _both(_frozen(ALL_CAMERAS), _reading(inject.repeated)),
        Fault.NOTHING_MOVES | Fault.ODOMETRY_STALE,
        error_m=0.8,
        # The car has gone farther than the frozen odometer explains: RELOCATED, and slow.
        well=SLOW,
        ends_s=BEGIN_S + 4.0,
        drive_s=BEGIN_S + 7.0,
    ),
    _stops(
        "the car is held fast",
        happens=lambda: _hold,
        faults=Fault.NOTHING_MOVES,
        error_m=0.15,
        ends_s=_ENDLESS,
    ),
    _lasts(
        "frames 150 ms late, odometry at 500 Hz",
        rates=Rates(odometry_period_s=0.002, frame_delay_s=0.15),
        begins_s=2.0,
        drive_s=4.0,
    ),
    _stops(
        "a marker to and fro for 7 s",
        happens=_to_and_fro,
        faults=Fault.RESTARTED_OFTEN,
        error_m=1.5,
        ends_s=_ENDLESS,
        drive_s=BEGIN_S + 7.0,
    ),
    # Nonsense.
    _slows(
        "corners at random places", inject.random_corners, rejects=Reject.INNOVATION, error_m=0.05
    ),
    _may_stop(
        "corners at random places from the start",
        inject.random_corners,
        rejects=Reject.INNOVATION,
        begins_s=0.0,
        ends_s=_ENDLESS,
    ),
    _stops(
        "odometry 0 without a marker",
        _both(_DARK, _speed(lambda mps: 0.0 * mps)),
        Fault.ODOMETRY_DOUBTFUL,
        error_m=0.10,
    ),
    _stops(
        "odometry x3 without a marker",
        _both(_DARK, _speed(lambda mps: 3.0 * mps)),
        Fault.ODOMETRY_DOUBTFUL,
        error_m=0.10,
    ),
    # Copies of the marker.
    _relocated(
        "a copy 1 m away instead", happens=_once(lambda world: world.move_markers((1.0, 0.0, 0.0)))
    ),
    _relocated(
        "a larger copy instead",
        happens=_once(lambda world: world.move_markers((0.0, 0.0, 0.0), scale=1.5)),
    ),
    _relocated(
        "a copy 1 m away instead, not to relocate",
        happens=_once(lambda world: world.move_markers((1.0, 0.0, 0.0))),
        health=(STOP, STOP),
        error_m=0.10,
        relocate=False,
    ),
    _copied(
        "a copy dragged at 0.1 m/s",
        happens=_dragged(0.1),
        faults=Fault.WAYS_DISPUTED,
        health=(SLOW, STOP),
        error_m=0.6,
    ),
    # Restart follows restart, and none of them is confirmed: the car stands.
    _copied(
        "a copy dragged at 0.5 m/s",
        happens=_dragged(0.5),
        faults=Fault.RESTARTED,
        health=(OK, STOP),
        error_m=0.3,
    ),
    # Maps.
    _may_slow(
        "one of three markers moved",
        happens=_once(lambda world: world.move_markers((0.3, 0.0, 0.0), slice(2, 3))),
        markers=_three,
        faults=Fault.MARKER_OUTVOTED,
        error_m=0.05,
        ends_s=_ENDLESS,
    ),
    # Maps so far away that float32 resolves only 0.5 m or 1 m there; nothing else is wrong.
    FaultRow("map 10 000 km from the origin", shift_m=(1e7, -1e7, 0.0)),
    FaultRow("map at UTM coordinates", shift_m=(448_251.37, 5_411_932.81, 0.0)),
    *_actuators(),
    _gyro_lies("a gyro stuck at 0", _dark_gyro(lambda: lambda rate_radps: 0.0)),
    _gyro_lies("a gyro of the wrong sign", _dark_gyro(lambda: lambda rate_radps: -rate_radps)),
    _gyro_lies("a gyro in degrees", _dark_gyro(lambda: np.rad2deg)),
    _gyro_lies("a gyro with 1 rad/s of noise", _dark_gyro(inject.noise)),
    # Frames taken earlier than their stamps, which no clock shows: this must be reported, but the
    # estimate's error meanwhile is not limited.
    _may_slow(
        "frames 50 ms late, unsaid, all",
        _stamps(lambda ns: ns + int(0.05 * 1e9)),
        Fault.CAMERA_LATE,
        error_m=math.inf,
        begins_s=0.0,
        ends_s=_ENDLESS,
        drive_s=10.0,
        rates=Rates(frame_delay_s=0.03 + 0.05),
    ),
)
