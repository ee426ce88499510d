"""The rows of the fault matrix, with the requirements of each."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.detection.types import Detections
from jaxnav.loop.flags import Fault, Health, Reject
from jaxnav.loop.interfaces import Odometry
from jaxnav.loop.pilot import Input
from jaxnav.models.markers import MarkerMap
from jaxnav.testing import injections as inject
from jaxnav.testing.faults import ALL_CAMERAS, BEGIN_S, FaultRow, Happens, lasting
from jaxnav.testing.lockstep import BEGIN_NS, Change, Rates
from jaxnav.testing.matrix_standstill import rates, standstill
from jaxnav.vehicles.world import SimWorld

_LATEST = np.inf  # to the end of the drive
_SLOW = Health.DEGRADED
_BLIND_S = (0.2, 1.0, 5.0, 20.0)


def matrix() -> list[FaultRow]:
    """All rows of the matrix."""
    return [
        FaultRow("none"),
        *_cameras(),
        *_frames(),
        *_markers(),
        *_stamps(),
        *_odometry(),
        *_calibration(),
        *_world(),
        *_loop(),
        *standstill(),
        *rates(),
        *_nonsense(),
        *_spoofed(),
        *_outvoted(),
        *_far_origins(),
        *_late_stamps(),
    ]


def _cameras() -> list[FaultRow]:
    rows = [
        FaultRow(
            f"camera {camera} out",
            lasting(partial(_frames_of, camera)),
            faults=Fault.CAMERA_STALE,
            at_most=_SLOW,
            error_m=0.10,
        )
        for camera in (0, 2)
    ]
    for duration_s in _BLIND_S:
        costs = _cost(duration_s)
        for name, edit, flag in (
            ("all cameras out", inject.gone, Fault.CAMERAS_STALE),
            ("tunnel", inject.nothing_seen, Fault.NO_MARKER),
        ):
            stale = flag if duration_s > 1 or (duration_s > 0.2 and "all" in name) else Fault(0)
            rows.append(
                FaultRow(
                    f"{name}, {duration_s:g} s",
                    lasting(partial(inject.frames, edit), BEGIN_S + duration_s),
                    faults=stale,
                    at_least=costs,
                    at_most=max(costs, _SLOW if "all" in name else Health.DEAD_RECKONING),
                    error_m=0.05 + 0.06 * min(duration_s, 5.0),
                    ends_s=BEGIN_S + duration_s,
                    drive_s=BEGIN_S + duration_s + 3,
                )
            )
    return rows


def _frames_of(camera: int) -> Change:
    return inject.frames(inject.only_camera(camera, inject.gone))


def _cost(blind_s: float) -> Health:
    if blind_s >= 5:
        return Health.STOP
    if blind_s > 2:
        return Health.DEGRADED
    return Health.OK


def _frames() -> list[FaultRow]:
    return [
        FaultRow(
            "None or wrong-size frames",
            lasting(lambda: inject.frames(inject.unusable)),
            faults=Fault.FRAME_UNUSABLE,
            at_most=_SLOW,
            error_m=0.15,
        ),
        FaultRow(
            "frozen images, new stamps",
            lasting(lambda: inject.frames(inject.frozen(ALL_CAMERAS, 0.0))),
            faults=Fault.FRAME_FROZEN,
            at_most=_SLOW,
            error_m=0.15,
        ),
        FaultRow(
            "NaN in corners",
            lasting(lambda: inject.frames(inject.corners(lambda c: c * np.nan))),
            faults=Fault.CORNERS_NOT_FINITE,
            at_most=_SLOW,
            error_m=0.15,
        ),
        FaultRow(
            "inf in corners",
            lasting(lambda: inject.frames(inject.corners(lambda c: c + np.inf))),
            faults=Fault.CORNERS_NOT_FINITE,
            at_most=_SLOW,
            error_m=0.15,
        ),
    ]


def _markers() -> list[FaultRow]:
    def renamed(detections: Detections) -> Detections:
        return dataclasses.replace(detections, ids=detections.ids + 7)

    def doubled(shift_px: float) -> Callable[[Detections], Detections]:
        def edit(detections: Detections) -> Detections:
            other = dataclasses.replace(detections, corners_px=detections.corners_px + shift_px)
            return Detections.concatenate([detections, other])

        return edit

    def mirrored(c: np.ndarray) -> np.ndarray:
        center = c.mean(axis=1, keepdims=True)
        return np.stack([2 * center[..., 0] - c[..., 0], c[..., 1]], axis=-1)[:, [1, 0, 3, 2]]

    return [
        FaultRow(
            "unknown id",
            lasting(lambda: inject.frames(inject.detections(renamed))),
            faults=Fault.UNKNOWN_MARKER,
            at_most=_SLOW,
            error_m=0.15,
        ),
        FaultRow(
            "two markers of one id",
            lasting(lambda: inject.frames(inject.detections(doubled(60.0)))),
            faults=Fault.DUPLICATE_MARKER,
            at_most=_SLOW,
            error_m=0.15,
        ),
        FaultRow(
            "duplicate detection",
            lasting(lambda: inject.frames(inject.detections(doubled(0.0)))),
        ),
        FaultRow(
            "mirrored corners, 5 frames",
            lasting(lambda: inject.frames(inject.corners(mirrored)), BEGIN_S + 0.17),
            at_most=_SLOW,
            error_m=0.10,
            ends_s=BEGIN_S + 0.17,
        ),
        FaultRow(
            "corners turned by 90 deg, 5 frames",
            lasting(
                lambda: inject.frames(inject.corners(lambda c: np.roll(c, 1, axis=1))),
                BEGIN_S + 0.17,
            ),
            rejects=Reject.INNOVATION,
            at_most=_SLOW,
            error_m=0.10,
            ends_s=BEGIN_S + 0.17,
        ),
    ]


def _stamps() -> list[FaultRow]:
    def shifted(by_s: float) -> Callable[[], Change]:
        return lambda: inject.frames(inject.stamps(lambda ns: ns + int(by_s * 1e9)))

    def constant(stamp_ns: int) -> Callable[[], Change]:
        return lambda: inject.frames(inject.stamps(lambda ns: stamp_ns))

    def drifting(ns: int) -> int:
        return ns + int((ns - BEGIN_NS) * 100e-6)

    def drifting_odometry(reading: Odometry) -> Odometry:
        return dataclasses.replace(reading, stamp_ns=drifting(reading.stamp_ns))

    def both(given: Input) -> list[Input]:
        edited = inject.frames(inject.stamps(drifting))(given)
        return inject.odometry(drifting_odometry)(edited[0])

    refused: dict[str, Any] = {"faults": Fault.STAMP_INVALID, "at_most": _SLOW, "error_m": 0.15}
    return [
        FaultRow("stamps jump by +1 s", lasting(shifted(1.0)), **refused),
        FaultRow("stamps jump by -1 s", lasting(shifted(-1.0)), **refused),
        FaultRow("frames 50 ms late, each other", lasting(lambda: inject.late(0.05, 2))),
        FaultRow(
            "frames 500 ms late, each third", lasting(lambda: inject.late(0.5, 3)), at_most=_SLOW
        ),
        FaultRow("equal stamps", lasting(constant(BEGIN_NS + 1)), **refused),
        FaultRow("zero stamps", lasting(constant(0)), **refused),
        FaultRow("negative stamps", lasting(constant(-5)), **refused),
        FaultRow("clocks that drift by 100 ppm", lambda: both, begins_s=2.0, ends_s=_LATEST),
        FaultRow(
            "cameras skewed by 30 ms",
            rates=Rates(camera_skew_s=0.03),
            begins_s=2.0,
            ends_s=_LATEST,
        ),
    ]


def _odometry() -> list[FaultRow]:
    def scaled(by: float) -> Callable[[], Change]:
        return lambda: inject.odometry(
            lambda reading: dataclasses.replace(reading, speed_mps=by * reading.speed_mps)
        )

    def spikes() -> Change:
        count = 0

        def edit(reading: Odometry) -> Odometry:
            nonlocal count
            count += 1
            by = 10.0 if count % 5 == 0 else 1.0
            return dataclasses.replace(reading, speed_mps=by * reading.speed_mps)

        return inject.odometry(edit)

    def wrapped(reading: Odometry) -> Odometry:
        # The wrap of 2^32 counts, each 1 / 15 000 m, in 20 ms.
        return dataclasses.replace(reading, speed_mps=reading.speed_mps - 2**32 / 15e3 / 0.02)

    def invalid(reading: Odometry) -> Odometry:
        return dataclasses.replace(reading, valid=False)

    return [
        FaultRow("odometry x10, each fifth", lasting(spikes), rejects=Reject.ODOMETRY),
        FaultRow(
            "odometry of the other sign",
            lasting(scaled(-1.0)),
            rejects=Reject.ODOMETRY,
            at_most=_SLOW,
            error_m=0.08,
        ),
        FaultRow("odometry 30 % off", lasting(scaled(1.3)), at_most=_SLOW, error_m=0.08),
        FaultRow(
            "odometry stuck",
            lasting(lambda: inject.odometry(inject.repeated())),
            faults=Fault.ODOMETRY_STUCK,
            at_most=_SLOW,
            error_m=0.08,
        ),
        FaultRow(
            "odometry invalid",
            lasting(lambda: inject.odometry(invalid)),
            faults=Fault.ODOMETRY_INVALID,
            at_least=_SLOW,
            at_most=_SLOW,
            error_m=0.08,
        ),
        FaultRow(
            "odometry out",
            lasting(lambda: inject.odometry(inject.gone)),
            faults=Fault.ODOMETRY_STALE,
            at_least=_SLOW,
            at_most=_SLOW,
            error_m=0.08,
        ),
        FaultRow(
            "odometry wraps around",
            lasting(lambda: inject.odometry(wrapped), BEGIN_S + 0.03),
            rejects=Reject.ODOMETRY,
            ends_s=BEGIN_S + 0.03,
        ),
        FaultRow(
            "NaN and inf in odometry",
            lasting(lambda: inject.odometry(inject.with_values(inject.NOT_FINITE))),
            faults=Fault.ODOMETRY_INVALID,
            at_most=_SLOW,
            error_m=0.08,
        ),
        FaultRow(
            "blind and without odometry",
            lasting(lambda: lambda given: [dataclasses.replace(given, odometry=None, frames=())]),
            faults=Fault.CAMERAS_STALE,
            at_least=Health.STOP,
            at_most=Health.STOP,
            error_m=0.30,
        ),
    ]


def _calibration() -> list[FaultRow]:
    lasting: dict[str, Any] = {"begins_s": 2.0, "ends_s": _LATEST, "drive_s": 6.0}
    return [
        FaultRow("cameras off by 1 deg, 1 cm", telling="extrinsics", error_m=0.15, at_most=_SLOW,
            **lasting),
        FaultRow("focal length off by 2 %", telling="focal", error_m=0.15, at_most=_SLOW,
            **lasting),
        FaultRow("cameras swapped", telling="swapped", error_m=np.inf, at_most=Health.STOP,
            rejects=Reject.INNOVATION, **(lasting | {"drive_s": 12.0})),  # to a side camera's view
    ]  # fmt: skip


def _once(act: Callable[[SimWorld], None]) -> Callable[[], Happens]:
    def made() -> Happens:
        done = False

        def happens(now_ns: int, world: SimWorld) -> None:
            nonlocal done
            if not done and now_ns >= BEGIN_NS + int(BEGIN_S * 1e9):
                done = True
                act(world)

        return happens

    return made


def _world() -> list[FaultRow]:
    return [
        FaultRow(
            "marker moved by 5 cm",
            happens=_once(lambda world: world.move_markers((0.05, 0.0, 0.0))),
            error_m=0.15,
            error_after_m=0.10,
            at_most=_SLOW,
            ends_s=BEGIN_S + 0.1,
        ),
        FaultRow(
            "kidnapped: 1 m, 90 deg",
            happens=_once(lambda world: world.carry_off((-0.7, -0.7, np.pi / 2))),
            faults=Fault.RESTARTED,
            rejects=Reject.INNOVATION,
            error_m=1.2,
            error_after_m=0.10,
            at_most=Health.STOP,
            ends_s=BEGIN_S + 0.1,
            well=_SLOW,  # for a metre
        ),
    ]


def _loop() -> list[FaultRow]:
    rows = []
    for stall_s in (0.05, 0.5, 1.5):
        rows.append(
            FaultRow(
                f"the loop stalls for {stall_s * 1e3:.0f} ms",
                partial(inject.stalled, BEGIN_S, stall_s),
                faults=Fault.CLOCK_JUMPED if stall_s > 1 else Fault(0),
                at_most=_SLOW if stall_s < 1 else Health.STOP,
                error_m=0.15,
                ends_s=BEGIN_S + stall_s,
            )
        )
    return rows


def _nonsense() -> list[FaultRow]:
    def anywhere() -> Change:
        rng = np.random.default_rng(0)
        return inject.frames(inject.corners(lambda c: rng.uniform([0, 0], [820, 410], c.shape)))

    def blind(by: float) -> Callable[[], Change]:
        """Hide all markers, and scale the measured speed."""

        def edit(reading: Odometry) -> Odometry:
            return dataclasses.replace(reading, speed_mps=by * reading.speed_mps)

        dark, scaled = inject.frames(inject.nothing_seen), inject.odometry(edit)
        return lambda: lambda given: [one for seen in dark(given) for one in scaled(seen)]

    doubted: dict[str, Any] = {
        "faults": Fault.ODOMETRY_DOUBTFUL,
        "at_least": Health.STOP,
        "at_most": Health.STOP,
        "error_m": 0.10,
    }
    return [
        FaultRow(
            "corners at random places",
            lasting(anywhere),
            rejects=Reject.INNOVATION,
            at_least=_SLOW,
            at_most=_SLOW,
        ),
        FaultRow(
            "corners at random places from the start",
            anywhere,
            rejects=Reject.INNOVATION,
            at_most=Health.STOP,
            begins_s=0.0,
            ends_s=_LATEST,
        ),
        FaultRow("odometry 0 without a marker", lasting(blind(0.0)), **doubted),
        FaultRow("odometry x3 without a marker", lasting(blind(3.0)), **doubted),
    ]


def _spoofed() -> list[FaultRow]:
    def dragged(by_mps: float) -> Callable[[], Happens]:
        def made() -> Happens:
            last_ns = BEGIN_NS + int(BEGIN_S * 1e9)

            def happens(now_ns: int, world: SimWorld) -> None:
                nonlocal last_ns
                if now_ns > last_ns:
                    world.move_markers((by_mps * (now_ns - last_ns) / 1e9, 0.0, 0.0))
                    last_ns = now_ns

            return happens

        return made

    moved = _once(lambda world: world.move_markers((1.0, 0.0, 0.0)))
    larger = _once(lambda world: world.move_markers((0.0, 0.0, 0.0), scale=1.5))
    lasting: dict[str, Any] = {"ends_s": _LATEST, "drive_s": 8.0, "at_most": Health.STOP}
    relocated = lasting | {"faults": Fault.RELOCATED, "at_least": _SLOW}
    return [
        # A copy of the only marker can't be told from it: a slow and reported reaction is required.
        FaultRow("a copy 1 m away instead", happens=moved, error_m=1.1, **relocated),
        FaultRow("a larger copy instead", happens=larger, error_m=1.1, **relocated),
        FaultRow(
            "a copy 1 m away instead, not to relocate",
            happens=moved,
            relocate=False,
            error_m=0.10,
            **(relocated | {"at_least": Health.STOP}),
        ),
        FaultRow(
            "a copy dragged at 0.1 m/s",
            happens=dragged(0.1),
            faults=Fault.WAYS_DISPUTED,
            at_least=_SLOW,
            error_m=0.6,
            **lasting,
        ),
        # Restart follows restart, and none of them is confirmed: the car stands.
        FaultRow(
            "a copy dragged at 0.5 m/s",
            happens=dragged(0.5),
            faults=Fault.RESTARTED,
            error_m=0.3,
            **lasting,
        ),
    ]


def _outvoted() -> list[FaultRow]:
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
        FaultRow(
            "one of three markers moved",
            happens=_once(lambda world: world.move_markers((0.3, 0.0, 0.0), slice(2, 3))),
            markers=three,
            faults=Fault.MARKER_OUTVOTED,
            at_most=_SLOW,
            ends_s=_LATEST,
        ),
    ]


def _far_origins() -> list[FaultRow]:
    """Maps so far away that float32 resolves only 0.5 m or 1 m there; nothing else is wrong."""
    return [
        FaultRow("map 10 000 km from the origin", shift_m=(1e7, -1e7, 0.0)),
        FaultRow("map at UTM coordinates", shift_m=(448_251.37, 5_411_932.81, 0.0)),
    ]


def _late_stamps() -> list[FaultRow]:
    """Frames taken earlier than their stamps, which no clock shows: this must be reported, but the
    estimate's error meanwhile is not limited."""
    late_s = 0.05
    return [
        FaultRow(
            "frames 50 ms late, unsaid, all",
            lambda: inject.frames(inject.stamps(lambda ns: ns + int(late_s * 1e9))),
            faults=Fault.CAMERA_LATE,
            at_most=_SLOW,
            error_m=np.inf,
            begins_s=0.0,
            ends_s=_LATEST,
            drive_s=10.0,
            rates=Rates(frame_delay_s=0.03 + late_s),
        ),
    ]
