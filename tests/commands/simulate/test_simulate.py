"""`jaxnav simulate` and `jaxnav reliability`: their counts, and the errors for bad input."""

import json
from typing import get_args

import numpy as np
import pytest

from jaxnav.cli import main
from jaxnav.commands.kinds import Selector, SimulatedSelector
from jaxnav.commands.simulate.arguments import Scenario
from jaxnav.commands.simulate.arguments import Simulate as Arguments
from jaxnav.commands.simulate.simulate import ScenarioCar, _navigator
from jaxnav.core.filter.selectors import SELECTORS
from jaxnav.core.parameters import parameters_of
from jaxnav.files import load_params, write_params
from jaxnav.recordings.drive_setup import PILOT_SELECTORS
from jaxnav.sim.rollout import Trace
from jaxnav.sim.scenarios import on_laps, scenarios
from jaxnav.sim.scores import Drives
from jaxnav.sim.statistics import Reliability

SCENARIO = scenarios()["paper"]


def trace(drives=4, frames=60, **changes) -> Trace:
    """Drives that know their pose from frame 5 on and pass both waypoints."""
    shape = (drives, frames)
    leaves = {
        "true_pose": np.zeros((*shape, 3)),
        "pose": np.zeros((*shape, 3)) + np.array([0.03, 0.04, 0.0]),
        "nees": np.full(shape, 3.0),
        "located": np.ones(shape, bool),
        "decided": np.broadcast_to(np.arange(frames) >= 5, shape).copy(),
        "flip_probability": np.zeros(shape),
        "lm_steps": np.ones(shape, int),
        "active": np.ones(shape, bool),
        "on_floor": np.ones(shape, bool),
        "passed": np.full(shape, 2),
        "done": np.zeros(shape, bool),
    }
    return Trace(**(leaves | changes))


def test_perfect_drives():
    summary = Drives.from_trace(trace(), SCENARIO).summary()
    assert summary["drives"] == 4
    assert summary["success_rate"]["value"] == 1
    assert 0.4 < summary["success_rate"]["interval"][0] < 0.6  # Wilson, 4 of 4
    assert summary["wrong_branch_fraction"]["value"] == 0
    assert summary["wrong_branch_fraction"]["interval"][1] > 0.5  # 4 drives prove little
    assert summary["time_to_decide_s"]["median"]["value"] == pytest.approx(5 / 15)
    assert summary["median_position_error_m"]["value"] == pytest.approx(0.05)
    assert summary["anees"]["value"] == pytest.approx(3)


def test_wrong_headings_and_failures_are_counted_where_they_are():
    pose, on_floor, passed = np.zeros((4, 60, 3)), np.ones((4, 60), bool), np.full((4, 60), 2)
    pose[0, :45, 2] = np.deg2rad(21.0)  # decided from 5, late from 30
    pose[1, :, 2] = 2 * np.pi + np.deg2rad(19.0)
    on_floor[0, 50:] = False  # it has left the floor
    passed[1] = 1  # it falls short of a waypoint
    drives = trace(pose=pose, on_floor=on_floor, passed=passed)
    summary = Drives.from_trace(drives, SCENARIO).summary()
    assert summary["wrong_branch_fraction"]["value"] == pytest.approx(45 / 240)
    assert summary["wrong_branch_fraction_after_2s"]["value"] == pytest.approx(15 / 120)
    assert summary["wrong_once_decided_fraction"]["value"] == pytest.approx(40 / 220)
    low, high = summary["wrong_branch_fraction"]["interval"]
    assert low <= 45 / 240 <= high
    assert summary["success_rate"]["value"] == 0.5


def test_drives_that_never_decide_count_as_never():
    decided = np.zeros((5, 60), bool)
    decided[:2, 5:] = True
    drives = Drives.from_trace(trace(5, decided=decided), SCENARIO)
    assert drives.time_to_decide_s.tolist() == [5 / 15, 5 / 15, np.inf, np.inf, np.inf]
    assert drives.summary()["time_to_decide_s"]["median"]["value"] == np.inf


def test_calibration_error_is_the_weighted_gap():
    probability = np.repeat([0.02, 0.52], [30, 10])
    happened = np.zeros(40, bool)
    happened[30:37] = True
    found = Reliability.from_predictions(probability, happened)
    assert found.counts.tolist() == [30, 10]
    assert found.expected_calibration_error == pytest.approx((30 * 0.02 + 10 * 0.18) / 40)


def test_errors_after_twenty_seconds_count_apart():
    times_s = np.arange(330) / 15
    pose = np.zeros((4, 330, 3))
    pose[..., 0] = np.where(times_s < 20 - 1e-9, 0.05, 0.01)
    nees = np.broadcast_to(np.where(times_s < 20 - 1e-9, 3.0, 9.0), (4, 330))
    drives = trace(frames=330, pose=pose, nees=nees)
    summary = Drives.from_trace(drives, on_laps(SCENARIO, 4)).summary()
    assert summary["median_position_error_m"]["value"] == pytest.approx(0.05)
    assert summary["median_position_error_m_after_20s"]["value"] == pytest.approx(0.01)
    assert summary["anees_after_20s"]["value"] == pytest.approx(9)
    assert np.isnan(summary["anees_after_60s"]["value"])  # no drive lasts so long
    assert not any("after_20s" in name for name in Drives.from_trace(drives, SCENARIO).summary())


def test_a_short_simulation_writes_its_numbers_and_resumes(tmp_path, stranger, capsys):
    """On its own route."""
    file = tmp_path / "s.json"
    words = ["--seeds", "3", "--selector", "oracle", *stranger.flags(), "--json", str(file)]
    assert main(["simulate", *words, "--headless"]) == 0
    row = capsys.readouterr().out.splitlines()[-1]
    result = json.loads(file.read_text())
    assert result["run"]["selector"] == "oracle"
    assert result["success_rate"]["value"] == 1
    assert row.startswith("| oracle | 1 | 100.0% |")
    assert main(["simulate", *words, "--headless", "--resume"]) == 0  # nothing is left to drive
    assert capsys.readouterr().out.splitlines()[-1] == row
    assert json.loads(file.read_text())["drives"] == 3


@pytest.mark.long
def test_parameters_drive_and_are_what_a_result_belongs_to(tmp_path, capsys, monkeypatch):
    file, params = tmp_path / "s.json", tmp_path / "params.yaml"
    gains = ("controller.proportional_per_m", "controller.integral_per_ms")
    write_params(params, dict.fromkeys(gains, 1e-6) | {"corner_sigma_px": 3.0})
    arguments = ["--seeds", "2", "--selector", "oracle", "--json", str(file), "--headless"]
    arguments += ["--scenario", "approach", "--params", str(params)]
    assert main(["simulate", *arguments]) == 0
    assert capsys.readouterr().out.startswith(f"3 parameters from {params}\n| selector |")
    result = json.loads(file.read_text())
    assert result["run"]["params"] == str(params)
    assert result["run"]["told_noise_px"] == 3.0
    assert result["success_rate"]["value"] == 0  # it hardly moves

    def drive(_args, _car, _scenario, key: dict) -> dict:
        driven.append(key)
        return {name: value for name, value in result.items() if name != "run"}

    driven: list[dict] = []
    monkeypatch.setattr("jaxnav.commands.simulate.simulate._drive", drive)
    assert main(["simulate", *arguments, "--resume"]) == 0
    assert driven == []
    for others, told_px in (([], 1.0), (["--params", str(params), "--told-noise-px", "2"], 2.0)):
        assert main(["simulate", *arguments[:-2], *others, "--resume"]) == 0
        assert driven[-1] == result["run"] | {
            "params": str(params) if others else None,
            "told_noise_px": told_px,
        }
    assert len(json.loads(file.read_text())["runs"]) == 3


def test_the_noise_that_is_told_goes_before_that_of_a_file(tmp_path):
    write_params(
        tmp_path / "p.yaml",
        {"corner_sigma_px": 3.0, "motion.tilt_sigma_rad": 0.5, "motion.height_sigma_m": 0.25},
    )
    path = tmp_path / "p.yaml"
    car = ScenarioCar.load(Arguments(params=path), load_params(path))
    found = parameters_of(_navigator(car, SCENARIO, "mahalanobis", 2.0))
    assert float(found["corner_sigma_px"]) == 2.0
    assert float(found["motion.tilt_sigma_rad"]) == 0.5  # before what the scenario tells
    assert float(found["motion.height_sigma_m"]) == 0.25


def test_a_name_without_a_gate_is_its_rule_on_a_filter_that_has_none():
    car = ScenarioCar.load(Arguments())
    for name in ("lowest-reprojection", "paper-cost"):
        gated, ungated = (
            _navigator(car, SCENARIO, name + ending, 1.0) for ending in ("", "-ungated")
        )
        assert type(ungated.selector) is type(gated.selector)
        gates = [float(one.motion.gate_nis) for one in (gated, ungated)]
        assert gates == [pytest.approx(21.1), np.inf]


@pytest.mark.long
def test_laps_are_driven_and_their_later_errors_shown(tmp_path, capsys):
    file = tmp_path / "s.json"
    arguments = ["--seeds", "2", "--selector", "oracle", "--json", str(file), "--headless"]
    arguments += ["--laps", "2", "--resume"]
    assert main(["simulate", *arguments]) == 0
    titles, rule, row = capsys.readouterr().out.splitlines()
    assert titles.endswith("| ANEES | cm after 20 s | ANEES after 20 s |")
    assert titles.count("|") == rule.count("|") == row.count("|") == 11
    assert row.startswith("| oracle | 1 | 100.0% |")
    assert "nan" not in row
    result = json.loads(file.read_text())
    assert result["run"]["laps"] == 2
    assert 30 < result["duration_s"]["median"]["value"] < 40
    assert 0 < result["median_position_error_m_after_20s"]["value"] < 0.1
    assert main(["simulate", *arguments]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == row
    del result["anees_after_20s"]
    file.write_text(json.dumps(result))
    assert main(["simulate", *arguments]) == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith("| nan |")


MISSING = {"value": None}  # of drives that never decided
MEASURED = dict.fromkeys(
    (
        "success_rate",
        "wrong_branch_fraction_after_2s",
        "wrong_once_decided_fraction",
        "median_position_error_m",
        "anees",
    ),
    MISSING,
) | {"time_to_decide_s": {"median": MISSING, "p95": MISSING}}


def test_all_selectors_have_a_row_and_a_name_on_the_command_line(capsys, monkeypatch):
    monkeypatch.setattr("jaxnav.commands.simulate.simulate._drive", lambda *_: MEASURED)
    assert main(["simulate", "--selector", "all", "--headless"]) == 0
    rows = [line.split(" | ")[0].strip("| ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert rows == list(SELECTORS)
    assert {"paper-cost-ungated", "lowest-reprojection-ungated"} < set(rows)
    assert {*get_args(SimulatedSelector)} == {*rows, "all"}
    assert {*get_args(Selector)} == {*PILOT_SELECTORS}
    assert {*get_args(Scenario)} == {*scenarios()}


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({}, None),
        ({"anees": None}, "anees: missing"),
        ({"anees": {"value": "3"}}, "anees.value: must be a number, got the text '3'"),
    ],
)
def test_what_is_missing_is_kept_and_what_lacks_something_not_resumed(
    tmp_path, capsys, change, line
):
    run = {"scenario": "paper", "selector": "oracle", "seeds": [0, 2]}
    run |= dict.fromkeys(("corner_noise_px", "told_noise_px"), 1.0)
    run |= dict.fromkeys(("rig", "markers", "vehicle"))
    result = {"run": run} | MEASURED | change
    result = {name: value for name, value in result.items() if value is not None}
    (tmp_path / "s.json").write_text(json.dumps({"runs": [result]}))
    arguments = ["--seeds", "3", "--selector", "oracle", "--resume", "--headless"]
    code = main(["simulate", *arguments, "--json", str(tmp_path / "s.json")])
    out, err = capsys.readouterr()
    if line is None:
        assert code == 0
        row = "| oracle | 1 | nan% | nan% | nan / nan | nan% | nan | nan |"
        assert out.splitlines()[-1] == row
    else:
        assert (code, err.count("\n")) == (2, 1)
        assert f"s.json: runs[0].{line}" in err


def test_random_views_are_drawn(tmp_path, capsys):
    assert main(["reliability", "--frames", "200", "--headless", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert 75 < summary["pairs"] < 175
    assert 0.01 < summary["flipped_fraction"] < 0.3
    assert summary["expected_calibration_error"] < 0.2
    assert (tmp_path / "reliability.png").stat().st_size > 5000
