"""Every script of examples/ runs, at a small size, with the result that it states.

They are imported and called in this process, so that a program is compiled once for all of them.
"""

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

import jaxnav as jn

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


def test_the_car_decides_and_drives_to_its_waypoints():
    told = importlib.import_module("drive").main(duration_s=20.0)
    assert told["done"]
    assert told["decided"]
    assert told["flip_probability"] < 0.01
    assert told["error_m"] < 0.05
    assert told["time_s"] < 15


def test_an_own_selector_steers_too():
    module = importlib.import_module("own_selector")
    assert isinstance(module.SteadyHeading(), jn.Selector)
    told = module.main(duration_s=12.0)
    assert told["default"]["done"]
    assert told["default"]["median_error_m"] < 0.05
    assert np.isfinite(told["SteadyHeading"]["median_error_m"])


def test_an_own_vehicle_is_driven():
    module = importlib.import_module("own_vehicle")
    told = module.main(duration_s=1.0, selector=jn.PaperCost())
    assert told["health"] in ("OK", "DEGRADED")  # it has not gone far enough to be confirmed
    assert told["moved_m"] > 0.1
    assert told["error_m"] < 0.1


def test_a_drive_is_many_drives_under_vmap():
    told = importlib.import_module("ten_thousand_drives").main(6, "paper-cost", duration_s=8.0)
    assert told["success"].shape == told["wrong_start"].shape == (6,)
    assert told["success"].any()
    assert not (told["success"] & told["wrong_start"]).all()


def test_the_gradient_is_that_of_a_finite_difference():
    told = importlib.import_module("gradient").main(frames=6)
    assert np.abs(told["gradient"]).max() > 1e-3
    np.testing.assert_allclose(told["gradient"], told["difference"], rtol=1e-2, atol=1e-6)


def test_a_rig_is_calibrated():
    told = importlib.import_module("calibrate_rig").main(frames=60)
    assert told["before"] == pytest.approx((50, 5), rel=0.01)
    assert told["after"][0] < 2
    assert told["after"][1] < 0.1


def test_a_recording_is_localised_anew():
    told = importlib.import_module("read_recording").main()
    assert told["inputs"] > 100
    assert told["frames"] > 30
    assert told["restarts"] == 0
    assert told["decided"]
    assert told["apart_m"] < 0.05


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_says_how_it_is_run(name):
    text = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    assert f"python examples/{name}.py" in text.split('"""')[1]
    assert 'if __name__ == "__main__":\n    ' in text
    assert not re.search(r"[\"'](/[a-z]+/|~)", text)
    assert f"[{name}.py]({name}.py)" in (FOLDER / "README.md").read_text(encoding="utf-8")
