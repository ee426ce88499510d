"""`jaxnav tune`: from the command line to its files, and the errors for bad input."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from jaxnav.cli import main
from jaxnav.commands.simulate.arguments import TuneController, TuneFilter
from jaxnav.commands.tune.controller import closed_loop, gains_of
from jaxnav.commands.tune.filter import space_of
from jaxnav.core.filter.choose import LowestReprojection
from jaxnav.experiments.tuning.drive_loss import DriveLoss
from jaxnav.files import load_params

FEW = ("--seeds", "2", "--held-out-seeds", "1", "--test-seeds", "2")


def test_the_command_weighs_as_the_loss_does_by_default():
    args = TuneController()
    assert DriveLoss(args.time, args.cross_track, args.effort, args.smoothness) == DriveLoss()


def test_a_base_has_gains_and_noise_of_its_own():
    """What is learned by default: all on which its drives depend, and nothing else."""
    common = {"controller.speed_mps", "controller.slows_per_s"}
    spot = {"controller.turns_per_s"}
    for base, imu, gains in (("differential", "consumer", common | spot), ("omni", "none", common)):
        args = TuneController(base=base, imu=imu)
        navigator = closed_loop(args, "paper").rollout.navigator
        assert set(gains_of(args, navigator).free) == gains
        told = SimpleNamespace(obs=SimpleNamespace(corner_sigma_px=None))
        learned = set(space_of(TuneFilter(base=base, imu=imu), navigator, told).free)
        gyro = {"motion.vehicle.gyro.noise_density"} if imu == "consumer" else set()
        assert {name for name in learned if "gyro" in name} == gyro
        assert {"motion.acceleration_density", "motion.odometry_sigma"} < learned


@pytest.mark.long
@pytest.mark.parametrize("stranger", ["crawler"], indirect=True)
def test_a_filter_is_tuned_and_the_result_taken(capsys, refusal, tmp_path, monkeypatch, stranger):
    """A better loss on what was held out; the same command has nothing left to do, another one is
    refused, and so are parameters that nothing can be learned about."""
    # A driver and a selector without a bank compile in a fifth of the time.
    monkeypatch.setattr("jaxnav.commands.tune.data.MultiHypothesis", LowestReprojection)
    few = (*FEW, "--selector", "lowest-reprojection", "--corner-noise-px", "0.3")
    few = (*few, *stranger.flags())
    start = tmp_path / "start.yaml"
    start.write_text("parameters:\n  motion.acceleration_density: [0.1, 0.1, 0.9]\n")
    out = tmp_path / "tuned"
    command = (
        *("tune", "filter", *few, "--params", str(start), "--out", str(out), "--steps", "12"),
        *("--train", "motion.acceleration_density", "corner_sigma_px", "--headless"),
    )
    assert main(list(command)) == 0
    text = capsys.readouterr().out
    assert "motion.acceleration_density: [0.1, 0.1, 0.9] -> " in text
    params = load_params(out / "params.yaml")
    assert np.all(params.values["motion.acceleration_density"] != [0.1, 0.1, 0.9])
    assert params.provenance["command"] == "tune filter"
    assert params.provenance["params"] == str(start)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["held_out_loss"]["after"] < summary["held_out_loss"]["before"]
    (judged,) = summary["test"].values()
    assert 0 < judged["after"]["position_rmse_m"]["value"] < 0.5
    assert (out / "report.png").stat().st_size > 10_000
    kept = (out / "params.yaml").read_bytes()
    assert main(list(command)) == 0
    assert "going on after step" in capsys.readouterr().out
    assert (out / "params.yaml").read_bytes() == kept
    assert main([*command, "--seed", "5"]) == 2
    assert "is of another run, whose seed is 0 and not 5" in capsys.readouterr().err
    begins = ("tune", "filter", *few, "--headless", "--out", tmp_path / "other")
    for name in ("motion.fame", "motion.gate_nis", "controller.lookahead_m", "selector.floor_m"):
        line = refusal(*begins, "--train", name)
        assert f"--train: there is no {name} to learn in this filter: expected one of" in line
    line = refusal(*begins, "--full", "corner_sigma_px")
    assert "--full: corner_sigma_px: is no covariance" in line
