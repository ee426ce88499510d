"""Every script of examples/ runs, at a small size, with the result that it states.

They are imported and called in this process, so that a program is compiled once for all of them.
"""

import importlib
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import jaxnav as jn
from jaxnav.drive.flags import Health
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import Setup
from jaxnav.drive.pilot import Input, Pilot
from jaxnav.vehicles import sim
from jaxnav.vehicles.conformance import check_cameras

FOLDER = Path(__file__).resolve().parents[1] / "examples"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py"))


@pytest.fixture(autouse=True)
def in_the_path(monkeypatch, tmp_path):
    """As for a script that is run; from another folder."""
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.chdir(tmp_path)


def test_the_likelier_pose_is_near_the_truth_and_the_other_is_not():
    told = importlib.import_module("one_marker").main(range_m=1.0, noise_px=0.1)
    assert told["rms_px"][0] < told["rms_px"][1]
    assert told["error_deg"][0] < 3 < 30 < told["error_deg"][1]
    assert told["error_m"][0] < 0.02


@pytest.mark.long
def test_the_car_decides_and_drives_to_its_waypoints():
    time_s, error_m, out = importlib.import_module("drive").main(duration_s=20.0)
    assert out.done
    assert out.decided
    assert out.flip_probability < 0.01
    assert error_m < 0.05
    assert time_s < 15


@pytest.mark.long
def test_an_own_selector_steers_too():
    module = importlib.import_module("own_selector")
    assert isinstance(module.SteadyHeading(), jn.Selector)
    told = module.main(duration_s=12.0)
    assert told["default"]["done"]
    assert told["default"]["median_error_m"] < 0.05
    assert np.isfinite(told["SteadyHeading"]["median_error_m"])


def _own_vehicle():
    """The script's module, a navigator, and the setup that a plug-in gets."""
    drive = importlib.import_module("drive")
    navigator = drive.make_navigator(jn.PaperCost())
    start_pose = jn.load_route(drive.QCAR / "route.yaml").start_pose
    setup = Setup(navigator.rig, navigator.markers, navigator.motion.vehicle, start_pose)
    return importlib.import_module("own_vehicle"), navigator, setup


def test_an_own_vehicle_keeps_its_promises_and_the_simulated_cameras_look_at_its_world(capsys):
    module, _, setup = _own_vehicle()
    module.main()
    speed_mps = float(re.search(r"makes ([\d.]+) m/s", capsys.readouterr().out).group(1))
    assert speed_mps > 0.1
    check_cameras(sim.open_cameras, setup, module.MyCar(setup))
    with pytest.raises(jn.BadInput, match="this one lacks it"):
        sim.open_cameras(setup, None)


@pytest.mark.long
def test_an_own_vehicle_is_driven(monkeypatch):
    """By the loop's pilot, 50 times a second of the test's own clock."""
    module, navigator, setup = _own_vehicle()
    now_ns = 1_000_000_000
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic_ns=lambda: now_ns))
    car, pilot = module.MyCar(setup), Pilot(navigator)
    for now_ns in range(now_ns, now_ns + 10**9, 20_000_000):  # noqa: B020
        seen = car.world.detections(now_ns)
        frames = tuple(FrameDetections(camera, now_ns, one) for camera, one in enumerate(seen))
        outcome = pilot.handle(Input(now_ns, car.read(), frames))
        car.write(outcome.steering_rad, outcome.throttle)
    true_pose = car.world.state(now_ns)[:3]
    assert outcome.health in (Health.OK, Health.DEGRADED)  # not confirmed in so short a way
    assert np.hypot(*(true_pose - setup.start_pose)[:2]) > 0.1
    assert np.hypot(*(true_pose - outcome.pose)[:2]) < 0.1


@pytest.mark.long
def test_a_drive_is_many_drives_under_vmap():
    told = importlib.import_module("ten_thousand_drives").main(6, "paper-cost", duration_s=8.0)
    assert told["success"].shape == told["wrong_start"].shape == (6,)
    assert told["success"].any()
    assert not (told["success"] & told["wrong_start"]).all()


@pytest.mark.long
def test_the_gradient_is_that_of_a_finite_difference():
    gradient, difference = importlib.import_module("gradient").main(frames=6)
    assert np.abs(gradient).max() > 1e-3
    np.testing.assert_allclose(gradient, difference, rtol=1e-2, atol=1e-6)


def test_a_rig_is_calibrated():
    told = importlib.import_module("calibrate_rig").main(frames=60)
    assert told["before"] == pytest.approx((50, 5), rel=0.01)
    assert told["after"][0] < 2
    assert told["after"][1] < 0.1


@pytest.mark.long
def test_a_recording_is_run_again_by_another_selector():
    told = importlib.import_module("read_recording").main()
    assert told["inputs"] > 100
    assert told["frames"] > 30
    assert told["restarts"] == 0
    assert told["apart_m"] < 0.05


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_says_how_it_is_run(name):
    text = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    assert f"python examples/{name}.py" in text.split('"""')[1]
    assert 'if __name__ == "__main__":\n    ' in text
    assert not re.search(r"[\"'](/[a-z]+/|~)", text)
    assert f"[{name}.py]({name}.py)" in (FOLDER / "README.md").read_text(encoding="utf-8")
