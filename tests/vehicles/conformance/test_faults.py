"""The fault matrix: every fault has the effect that docs/promises.md states."""

import dataclasses
from collections.abc import Iterator

import jax
import numpy as np
import pytest

from jaxnav.core.navigator import Navigator, Output
from jaxnav.detection import make_detector
from jaxnav.drive.expect import Region, expect_corners
from jaxnav.drive.flags import Fault, Health
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import Frame
from jaxnav.drive.pilot import Pilot
from jaxnav.drive.seeing import Search
from jaxnav.sim.bases import BASES, equipped
from jaxnav.sim.rendering import Renderer
from jaxnav.sim.scene import Scene
from jaxnav.sim.sensor import Sensor
from jaxnav.vehicles.conformance import injections as inject
from jaxnav.vehicles.conformance.faults import WAYPOINTS_M, FaultRow, Trial, line, run_trial
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, drive
from jaxnav.vehicles.conformance.matrix import MATRIX
from jaxnav.vehicles.world import SimWorld
from tests import worlds


def trial_of(base: str, imu: str) -> Trial:
    return Trial(worlds.qcar_rig(), worlds.paper_markers(), equipped(worlds.qcar(), base, imu))


BOTH = ["float64", pytest.param("float32", marks=pytest.mark.long)]


@pytest.fixture(scope="module", params=BOTH)
def trial(request) -> Iterator[Trial]:
    with jax.enable_x64(request.param == "float64"):
        yield trial_of("ackermann", "none")


@pytest.fixture(scope="module", params=BOTH)
def trials(request) -> Iterator[dict[str, Trial]]:
    """Of every vehicle that has a gyro."""
    with jax.enable_x64(request.param == "float64"):
        yield {base: trial_of(base, "consumer") for base in BASES}


# One of each kind, for every change; `make test-all` drives them all.
OFTEN = {
    "none", "corners at random places", "a copy that another camera sees", "marker size x2",
    "kidnapped: 1 m, 90 deg", "the loop stalls for 500 ms",
    "servo dead at 0.3 rad, odometer as told, from the start",
}  # fmt: skip


CAR_ROWS = [
    pytest.param(row, id=row.name, marks=() if row.name in OFTEN else pytest.mark.long)
    for row in MATRIX
    if "ackermann" in row.bases and not row.gyro
]
# What the car shows as well, and whose judge is tested on every base by itself.
OTHER_ROWS = [
    pytest.param(base, row, id=f"{row.name}-{base}", marks=pytest.mark.long)
    for row in MATRIX
    for base in row.bases
    if row.gyro or base != "ackermann"
]


@pytest.mark.parametrize("row", CAR_ROWS)
def test_every_fault_comes_to_what_it_must(trial, row):
    result = run_trial(row, trial)
    assert result.broken == (), line(result)


@pytest.mark.parametrize(("base", "row"), OTHER_ROWS)
def test_every_fault_of_other_vehicles_comes_to_what_it_must(trials, base, row):
    result = run_trial(row, trials[base])
    assert result.broken == (), line(result)


class FrozenPicture:
    """From an instant on the front camera shows one picture, with a clock in its corner."""

    def __init__(self, trial: Trial, world: SimWorld, navigator: Navigator, begin_s: float):
        self.world, self.navigator, self.begin_ns = world, navigator, BEGIN_NS + int(begin_s * 1e9)
        scene = Scene.create(trial.markers, seed=0)
        self.renderer = Renderer(scene, trial.rig, sensor=Sensor(), threads=1)
        detectors = [make_detector("aruco", "tag36h11")]
        self.search = Search(0, trial.rig.image_sizes_px[0], trial.rig.camera(0), detectors)
        self.picture: np.ndarray | None = None
        self.output: Output | None = None

    def edit(self, frame: FrameDetections) -> FrameDetections:
        """As whoever looks at pictures: near where the marker is expected, or everywhere."""
        if frame.camera != 0 or frame.stamp_ns < self.begin_ns:
            return frame
        if self.picture is None:
            rng, pose = np.random.default_rng(0), self.world.pose(frame.stamp_ns)
            self.picture = self.renderer.render_still(pose, rng)[0]
        image = self.picture.copy()
        image[:8, :8] = np.frombuffer(frame.stamp_ns.to_bytes(8), np.uint8)
        rig, markers = self.navigator.rig, self.navigator.markers
        wxyz_xyz = np.asarray(self.output.T_world_vehicle.wxyz_xyz)
        found = expect_corners(rig, markers, wxyz_xyz, np.asarray(self.output.covariance[:3, :3]))
        quads_px, visible, radius_px = (np.asarray(part)[0] for part in found)
        region = Region(quads_px[visible], radius_px[visible])
        return self.search.look(Frame(frame.stamp_ns, image), region)


@pytest.mark.long
def test_a_picture_that_freezes_does_not_lead_the_car_astray(trial):
    """Looked at as on the car, near and whole in turn, for four seconds."""
    begin_s = 2.5
    navigator = Navigator(
        trial.rig, trial.markers, trial.vehicle, WAYPOINTS_M, waypoint_radius_m=0.15
    )
    pilot = Pilot(navigator)
    world = SimWorld(trial.rig, trial.markers, trial.vehicle, trial.start_pose, BEGIN_NS)
    frozen = FrozenPicture(trial, world, navigator, begin_s)
    steps = []
    for step in drive(pilot, world, begin_s + 4.0, inject.frames(frozen.edit)):
        frozen.output = step.outcome.output
        steps.append(step)
    faults = [(step.input.now_ns - BEGIN_NS, step.outcome.faults) for step in steps]
    seen_s = [ns / 1e9 - begin_s for ns, fault in faults if Fault.FRAME_FROZEN in fault]
    assert 0 < seen_s[0] < 1.3
    truths = np.array([step.truth[:2] for step in steps])
    poses = np.array([step.outcome.output.pose[:2] for step in steps])
    lasts = np.array([ns > begin_s * 1e9 for ns, _ in faults])
    assert np.hypot(*np.diff(truths[lasts], axis=0).T).sum() > 0.5  # it has driven
    assert np.hypot(*(poses - truths)[lasts].T).max() < 0.2
    assert Fault.CAMERA_STALE in steps[-1].outcome.faults
    assert steps[-1].outcome.health > Health.OK


def test_what_is_asked_of_a_fault_can_be_missed(trial):
    """The same measure finds fault with a drive in which the wrong thing is asked for."""
    tunnel = next(row for row in MATRIX if row.name == "tunnel, 5 s")
    asked = dataclasses.replace(
        tunnel, faults=Fault.ODOMETRY_STUCK, health=(Health.OK, Health.OK), error_m=0.0, drive_s=9.0
    )
    broken = run_trial(asked, trial).broken
    assert any("ODOMETRY_STUCK" in said for said in broken)
    assert any("health STOP" in said for said in broken)
    assert any("error" in said for said in broken)


def test_rows_have_names_of_their_own():
    names = [row.name for row in MATRIX]
    assert len(set(names)) == len(names)
    assert set(names) >= OFTEN
    assert all(isinstance(row, FaultRow) and np.isfinite(row.drive_s) for row in MATRIX)
