"""Cameras later than their stamps are distinguished from all other faults."""

import dataclasses
import math
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax
import numpy as np
import pytest

from jaxnav.commands.doctor import plug_ins
from jaxnav.commands.drive.observers import (
    DelayWatch,
    delay_warnings,
    delays_of,
    describe_delay,
)
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.detection import Detections
from jaxnav.drive.camera_delays import HARMLESS_S, KNOWN_S, SURE_SIGMAS, CameraDelays, Delay
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections, FrameIntake
from jaxnav.drive.history import EventData
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input
from jaxnav.sim.corners import see
from tests import worlds
from tests.helpers.drives import make_outcome
from tests.helpers.simulated import make_setup

RIG, MARKERS, VEHICLE = worlds.qcar_rig(), worlds.paper_markers(), worlds.qcar()
STEP_S, FRAME_S, READING_S = 0.005, 1 / 30, 0.02
BEGIN_NS = 10**9
START = (0.2, -1.2, math.radians(100.0))  # the marker ahead


@cache
def _views():
    return jax.jit(jax.vmap(lambda pose: see(RIG, MARKERS, T_world_vehicle_from_planar(pose))))


@dataclasses.dataclass(frozen=True)
class Drive:
    """Weaving towards the marker and back; what is wrong with it."""

    late_s: float = 0.0
    cameras: tuple[int, ...] = (0, 1, 2, 3)  # that are late
    corner_px: float = 0.5
    odometer_scale: float = 1.0
    weave_rad: float = 0.35
    speed_mps: float = 0.3
    duration_s: float = 9.0

    def track(self) -> tuple[np.ndarray, np.ndarray]:
        """Times, and rows x y psi speed steering."""
        times_s = np.arange(0, self.duration_s, STEP_S)
        steering = self.weave_rad * np.sin(2 * np.pi * times_s / 2.7)
        speed = self.speed_mps * np.sign(np.sin(2 * np.pi * times_s / 7.0) + 1e-9)
        beta = np.arctan(np.tan(steering) / 2)
        turn = speed * np.cos(beta) * np.tan(steering) / float(VEHICLE.wheelbase_m)
        psi = START[2] + np.cumsum(turn * STEP_S) - turn * STEP_S / 2
        x = START[0] + np.cumsum(STEP_S * speed * np.cos(psi + beta))
        y = START[1] + np.cumsum(STEP_S * speed * np.sin(psi + beta))
        return times_s + STEP_S / 2, np.stack([x, y, psi, speed, steering], axis=1)

    def inputs(self) -> list[tuple[Input, np.ndarray]]:
        """What the sensors say, and the pose then, about."""
        rng = np.random.default_rng(0)
        times_s, rows = self.track()

        def at(when_s):
            return np.stack([np.interp(when_s, times_s, row) for row in rows.T], axis=1)

        frames_s = np.arange(0.3, self.duration_s - 0.1, FRAME_S)
        true, late = (jax.device_get(_views()(at(frames_s - s)[:, :3])) for s in (0.0, self.late_s))
        readings_s = np.arange(0.0, self.duration_s, READING_S)
        read = at(readings_s)[:, 3:] * [self.odometer_scale, 1.0]
        read += rng.normal(0, [0.01, 0.005], read.shape)
        events = [
            (s, Odometry(_ns(s), *row.tolist())) for s, row in zip(readings_s, read, strict=True)
        ]
        for index, when_s in enumerate(frames_s):
            seen = []
            for camera in range(len(RIG)):
                corners_px, visible = late if camera in self.cameras else true
                which = np.flatnonzero(visible[index, camera])
                noise_px = rng.normal(0, self.corner_px, (len(which), 4, 2))
                found = Detections(
                    np.array(MARKERS.ids)[which],
                    corners_px[index, camera][which] + noise_px,
                    np.full((len(which), 4), self.corner_px),
                    np.ones(len(which), bool),
                    tuple(MARKERS.families[m] for m in which),
                )
                seen.append(FrameDetections(camera, _ns(when_s), found))
            events.append((when_s + 0.03, tuple(seen)))
        off = rng.normal(0, 0.02, 3)
        told = []
        for when_s, event in sorted(events, key=lambda pair: pair[0]):
            pose = at(np.array([when_s]))[0, :3] + off
            is_reading = isinstance(event, Odometry)
            given = Input(_ns(when_s), event) if is_reading else Input(_ns(when_s), frames=event)
            told.append((given, pose))
        return told

    def log(self, setup):
        """As a recorded drive has it."""
        told = self.inputs()
        outcomes = SimpleNamespace(
            now_ns=np.array([given.now_ns for given, _ in told]),
            pose=np.array([pose for _, pose in told]),
            decided=np.arange(len(told)) > 20,
        )
        inputs = tuple(given for given, _ in told)
        return SimpleNamespace(inputs=inputs, outcomes=outcomes, header=setup.header())


def _ns(when_s: float) -> int:
    return BEGIN_NS + round(when_s * 1e9)


SETUP = dataclasses.replace(make_setup(), markers=MARKERS)


def found_on(drive: Drive, setup=SETUP) -> CameraDelays:
    return delays_of(drive.log(setup), setup)


@pytest.mark.parametrize("late_s", [-0.05, 0.0, 0.15])
def test_a_delay_is_found_to_its_sigma(late_s):
    delays = found_on(Drive(late_s))
    front = delays.delays[0]
    assert front.known
    assert abs(front.delay_s - late_s) < 4 * front.sigma_s
    assert abs(front.delay_s - late_s) < 0.02
    assert front.late == (late_s != 0)
    assert delays.late == (late_s != 0)


@pytest.mark.parametrize(
    "wrong",
    [{"late_s": 0.02}, {"odometer_scale": 1.1}, {"odometer_scale": 0.9}, {"corner_px": 2.0}],
    ids=str,
)
def test_what_is_harmless_or_no_delay_is_not_told_as_one(wrong):
    assert not found_on(Drive(**wrong)).late


def test_one_camera_alone_is_told_by_its_name():
    delays = found_on(Drive(0.06, cameras=(0,)))
    assert delays.delays[0].late
    lines = list(delay_warnings(delays, SETUP))
    assert len(lines) == 1
    assert lines[0].startswith(f"camera {RIG.names[0]!r} is ")
    assert "ms later than stamps say: raise its latency_ms by" in lines[0]


@pytest.mark.parametrize(
    "drive", [Drive(0.05, weave_rad=0.0, speed_mps=0.1), Drive(0.05, speed_mps=0.0)], ids=str
)
def test_a_drive_that_does_not_tell_says_so(drive):
    """Straight on and standing: the same whatever the delay."""
    front = found_on(dataclasses.replace(drive, duration_s=3.4)).delays[0]
    assert not front.known
    assert not front.late


def test_what_is_corrected_already_is_not_found_again():
    """The estimate is on top of `camera_delay_s`, which the warning adds."""
    vehicle = dataclasses.replace(VEHICLE, camera_delay_s=0.05)
    setup = dataclasses.replace(SETUP, vehicle=vehicle)
    right = found_on(Drive(0.05), setup)
    assert not right.late
    assert abs(right.delays[0].delay_s) < HARMLESS_S
    twice = found_on(Drive(0.12), setup)
    (line,) = delay_warnings(twice, setup)
    number = float(line.split("camera_delay_s to ")[1].split()[0])
    assert number == pytest.approx(0.12, abs=0.02)


def test_a_delay_is_late_only_where_it_is_sure():
    sure = HARMLESS_S + SURE_SIGMAS * 0.005
    assert Delay(sure + 1e-3, 0.005).late
    assert Delay(-sure - 1e-3, 0.005).late
    assert not Delay(sure - 1e-3, 0.005).late
    assert not Delay(0.5, 2 * KNOWN_S).late
    assert not Delay(math.nan, math.inf).late


def test_stretches_that_contradict_each_other_widen_sigma():
    delays = CameraDelays(RIG, MARKERS, VEHICLE)
    information = 1 / 0.004**2
    for delay_s in (0.0, 0.1):
        delays._sums[0] += information * np.array([1.0, delay_s, delay_s**2])
        delays._counts[0] += 1
    assert delays.delays[0].delay_s == pytest.approx(0.05)
    assert not delays.delays[0].known


def outcome_of(given: Input, pose: np.ndarray, frames: FrameIntake):
    """Of a pilot that believes all, and knows where it is."""
    outcome = make_outcome(1)
    output = eqx.tree_at(lambda o: (o.pose, o.decided), outcome.output, (pose, np.array(True)))
    told, stamp_ns, _ = frames.check(given.frames, given.now_ns)
    if given.odometry is not None:
        told, stamp_ns = EventData(given.odometry.values), given.odometry.stamp_ns
    return dataclasses.replace(
        outcome, now_ns=given.now_ns, stamp_ns=stamp_ns, data=told, output=output
    )


def test_while_it_drives_one_warning_is_given(capsys):
    watch, frames = DelayWatch(SETUP, warns=True), FrameIntake(len(RIG), MARKERS)
    assert (watch.faults, watch.closing_note) == (Fault(0), None)
    for given, pose in Drive(0.06).inputs():
        watch.on_outcome(given, outcome_of(given, pose, frames))
    for _ in range(3000):
        if watch.faults:
            break
        watch._thread.join(0.02)
    watch.close()
    assert watch.faults == Fault.CAMERA_LATE
    assert "ms later than stamps say" in (watch.closing_note or "")
    assert capsys.readouterr().err.count("later than stamps say") == 1


def test_the_doctor_tells_it_of_a_recorded_drive(monkeypatch):
    path = Path("drive.mcap")
    monkeypatch.setattr(plug_ins, "read_drive", lambda _: Drive(0.05).log(SETUP))
    late = list(plug_ins.stamps(path))
    assert late[0].level == "warning"
    assert "later than stamps say" in late[0].what
    assert "camera_delay_s" in late[0].do
    monkeypatch.setattr(plug_ins, "read_drive", lambda _: Drive().log(SETUP))
    fine = list(plug_ins.stamps(path))
    assert {finding.level for finding in fine} <= {"ok", "note"}
    assert fine[0].level == "ok"
    assert any("does not tell" in finding.what for finding in fine)  # who saw no marker
    assert describe_delay(Delay(-0.0304, 0.0004)) == "30 +- 1 ms earlier than stamps say"
