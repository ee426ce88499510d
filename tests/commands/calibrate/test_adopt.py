"""`jaxnav calibrate adopt`: new files, with which the drive would have had nothing to learn."""

import dataclasses
import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.cli import main
from jaxnav.core.filter.odometry import LEARNT, SENSORS_END, SIX, SLIP
from jaxnav.core.models.vehicle import DEFAULT_SENSOR_SIGMA
from jaxnav.files import load_rig, load_vehicle, save_rig, save_vehicle
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import OUTCOME, outcome_message
from tests.helpers.drives import make_outcome
from tests.helpers.simulated import make_setup
from tests.recordings.test_learnt import SIGMA, told_rig, turned

TURN_RAD = np.deg2rad([0.3, -0.2, 1.2])  # of the second camera, about the vehicle's axes
SENSORS, SENSORS_SIGMA = np.array([0.02, -0.01, 0.004, 0.012]), np.array([2, 10, 1, 3]) * 1e-3
CAMERA = 1


def setup_of():
    setup = make_setup()
    vehicle = dataclasses.replace(
        setup.vehicle,
        sensor_sigma=jnp.asarray(DEFAULT_SENSOR_SIGMA),
        speed_scale=1.1,
        steering_gain=0.9,
        steering_offset_rad=0.02,
        camera_delay_s=0.01,
    )
    return dataclasses.replace(setup, rig=told_rig(), vehicle=vehicle, float64=True)


def learnt_outcome(index: int, learnt: bool = True, decided: bool = True):
    """A hypothesis that slips and has learnt errors of sensors and cameras; the heaviest of two."""
    outcome = make_outcome(index)
    count = SENSORS_END + 3 * 4
    sensors, turn = slice(LEARNT, SENSORS_END), slice(SENSORS_END + 3, SENSORS_END + 6)
    mean, variance = np.zeros((4, count)), np.ones(count)
    mean[1, SLIP], variance[SLIP] = 0.2, 0.05**2
    mean[1, sensors], variance[sensors] = SENSORS * index / 9, SENSORS_SIGMA**2
    mean[1, turn] = -TURN_RAD / SIGMA[3:] * index / 9
    variance[SENSORS_END:] = 0.1**2
    if not learnt:
        mean, variance = mean[:, :SIX], variance[:SIX]
    told = mean, np.tile(np.diag(variance), (4, 1, 1)), np.array([0.0, -0.1, -2.0, 0.0])
    belief, output = eqx.tree_at(
        lambda both: (
            both[0].bank.mean,
            both[0].bank.covariance,
            both[0].bank.log_weight,
            both[1].decided,
        ),
        (outcome.belief, outcome.output),
        (*told, np.asarray(decided)),
    )
    return dataclasses.replace(outcome, output=output, belief=belief)


def record(path, outcomes):
    recorder = Recorder(path, setup_of().header())
    for outcome in outcomes:
        recorder.put(OUTCOME, outcome.now_ns, outcome_message(outcome))
    recorder.close()
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Ten outcomes, the last two of which are not decided."""
    outcomes = [learnt_outcome(index, decided=index < 10) for index in range(12)]
    return record(tmp_path_factory.mktemp("drive") / "drive.mcap", outcomes)


def adopt(*arguments) -> int:
    return main(["calibrate", "adopt", *map(str, arguments), "--headless"])


def test_the_new_files_are_the_old_ones_corrected(recording, tmp_path, capsys):
    assert adopt(recording, "--out", tmp_path) == 0
    old = setup_of()
    rig, vehicle = load_rig(tmp_path / "rig.yaml"), load_vehicle(tmp_path / "vehicle.yaml")
    expected = turned(old.rig, CAMERA, TURN_RAD)
    for one, other in zip(rig.Ts_camera_vehicle.as_matrix(),
                          expected.Ts_camera_vehicle.as_matrix(), strict=True):  # fmt: skip
        np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_allclose(rig.extrinsics_sigma[:, :3], 0.005)
    np.testing.assert_allclose(rig.extrinsics_sigma[:, 3:], 0.1 * SIGMA[3], rtol=1e-6)
    # A reading by the old file, corrected by what was learnt, is the reading by the new one.
    k, g, offset, delay = SENSORS
    for read in (-0.3, 0.0, 0.2):
        before = 0.9 * read + 0.02
        assert vehicle.steering_gain * read + vehicle.steering_offset_rad == pytest.approx(
            (1 + g) * before + offset
        )
    assert vehicle.speed_scale == pytest.approx(1.1 * (1 + k))
    assert vehicle.camera_delay_s == pytest.approx(0.01 + delay)
    np.testing.assert_allclose(vehicle.sensor_sigma, SENSORS_SIGMA)
    told = capsys.readouterr().out
    assert f"camera {old.rig.names[CAMERA]} looks 1.20 deg too far left" in told
    assert "speed_scale is off by +0.0200" in told
    assert "rig.yaml, vehicle.yaml, report.json, report.png" in told
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["sensors"]["camera_delay_s"] == pytest.approx({"value": 0.012, "sigma": 0.003})
    assert report["time_s"] == pytest.approx(0.09)
    assert "calibrate adopt" in (tmp_path / "rig.yaml").read_text()


def test_a_rig_with_finer_figures_keeps_them(recording, tmp_path):
    rig = told_rig()
    cameras = dataclasses.replace(rig.cameras, focal_px=rig.cameras.focal_px * 1.001)
    save_rig(tmp_path / "mine.yaml", dataclasses.replace(rig, cameras=cameras))
    assert adopt(recording, "--rig", tmp_path / "mine.yaml", "--out", tmp_path / "out") == 0
    adopted = load_rig(tmp_path / "out" / "rig.yaml")
    np.testing.assert_array_equal(adopted.cameras.focal_px, cameras.focal_px)


@pytest.mark.parametrize("flag", ["--rig", "--vehicle"])
def test_files_of_another_drive_are_refused(recording, tmp_path, refusal, flag):
    setup, path = setup_of(), tmp_path / "other.yaml"
    if flag == "--rig":
        save_rig(path, turned(setup.rig, 0, np.array([0, 0, 0.01])))
    else:
        save_vehicle(path, dataclasses.replace(setup.vehicle, speed_scale=1.2))
    words = (recording, flag, path, "--out", tmp_path / "out", "--headless")
    line = refusal("calibrate", "adopt", *words)
    assert str(path) in line
    assert "was driven with" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("outcomes", "says"),
    [
        ([learnt_outcome(1, learnt=False)], "a rule of one pose"),
        ([learnt_outcome(1, decided=False)], "never was sure"),
        ([], "a rule of"),
    ],
)
def test_a_drive_that_has_learnt_nothing_is_refused(tmp_path, refusal, outcomes, says):
    path = record(tmp_path / "drive.mcap", outcomes)
    words = ("calibrate", "adopt", path, "--out", tmp_path / "out", "--headless")
    assert says in refusal(*words)
    assert not (tmp_path / "out").exists()
