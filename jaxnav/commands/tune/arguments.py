"""Arguments of `jaxnav tune`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from annotated_types import Interval

from jaxnav.commands.kinds import (
    Believed,
    CornerSigma,
    Count,
    NotNegative,
    OptionalFile,
    Positive,
    ResultsFolder,
    Scenario,
    ScenarioCarFiles,
    Seed,
    optional,
    require,
)

_Names = Annotated[tuple[str, ...], optional("NAME", "")]


@dataclass(frozen=True)
class TuneFilter(ScenarioCarFiles):
    """Learn the filter's noise, Q and R, from recordings or from simulated drives.

    By default it asks no truth: it makes the corners of every frame as likely as can be, given all
    that came before. Which pose of a marker is the true one is told in hindsight by the whole
    estimator, and fixed; it is told anew when the descent (BFGS) has ended, until that changes
    nothing. Of recordings the last quarter, of simulated drives other seeds, are held out and
    decide when to stop. In the end the estimators before and after run over drives that had no
    part in any of this.

    Written to --out: params.yaml, which demo, simulate, replay and run take with --params, the best
    so far at any time; report.png; summary.json. The same command goes on where it was interrupted.
    """

    recordings: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], optional("RECORDING", "(default: simulated drives)")
    ] = ()
    """Drives (.mcap), or rigs: folders of TagSLAM, .npz, ROS 1 bags with --rig and --markers."""
    test: Annotated[tuple[Path, ...], optional("RECORDING")] = ()
    """Recordings to hold the result against, whole."""
    part: tuple[float, float] = (0.0, 1.0)
    """What part of every recording is learned from; the rest is held against the result."""
    scenario: Scenario = "paper"
    """What happens in simulated drives."""
    corner_noise_px: CornerSigma = 1.0
    """Of simulated drives."""
    seeds: Count = 64
    """Simulated drives to learn from."""
    held_out_seeds: Count = 32
    """Simulated drives that decide when to stop."""
    test_seeds: Count = 200
    """Simulated drives for the report."""
    seed: Annotated[int, Interval(ge=0, lt=10**6)] = 0
    """The first seed; test drives count from a million on."""
    loss: Literal["likelihood", "score", "error"] = "likelihood"
    """Likelihood of the corners, which asks no truth; density of the true pose under what is
    believed; or squared position error."""
    train: _Names = ()
    """Parameters to learn, e.g. motion.odometry_sigma corner_sigma_px; by default of a vehicle Q
    and all of R that this selector looks at, of a rig Q."""
    full: _Names = ()
    """Those that are to be whole matrices."""
    params: OptionalFile = None
    """Where to start: a file of parameters."""
    selector: Believed = "multi-hypothesis"
    steps: Count = 150
    """At most so many evaluations."""
    out: ResultsFolder = Path("tuned")

    def __post_init__(self) -> None:
        super().__post_init__()
        for flag, plain in (
            ("--base", self.base == "ackermann"),
            ("--imu", self.imu == "none"),
            ("--route", self.route is None),
        ):
            alone = plain or not self.recordings
            require(alone, flag, "is of simulated drives: recordings tell what drove")
        most = 10**6 - self.seed - self.seeds
        require(self.held_out_seeds <= most, "--seeds", "test drives count from a million on")
        begin, end = self.part
        bounds = f"must be two parts of 1, the first below the second, got {begin:g} {end:g}"
        require(0 <= begin < end <= 1, "--part", bounds)


@dataclass(frozen=True)
class TuneController(ScenarioCarFiles):
    """Learn the controller's gains from simulated drives.

    The loss of a drive is a weighed sum of the time to the last waypoint, the distance from the
    straight lines between waypoints, the effort and the jerkiness of the commands. Every step of
    Adam drives other seeds: start, noise, and the true car's lag, slip and latency are drawn anew.
    The switch from waypoint to waypoint is soft for the gradient's sake and hard in all that is
    reported; which pose of a marker is believed stays the estimator's own choice. Held-out seeds
    decide when to stop, and the report is of drives never seen before. Limits are kept.

    Written to --out: params.yaml, which demo, simulate, replay and run take with --params, the best
    so far at any time; report.png; summary.json. The same command goes on where it was interrupted.
    """

    scenario: Scenario = "paper"
    """What happens in the drives to learn from."""
    test_scenario: tuple[Scenario, ...] = ("paper", "slip", "miscalibrated")
    """What happens in the drives for the report."""
    corner_noise_px: CornerSigma = 1.0
    """Standard deviation of the corners."""
    seeds: Count = 256
    """Drives a step; from 256 on they run on all cores, in a program that compiles for minutes."""
    held_out_seeds: Count = 128
    """Drives that decide when to stop, the same in every step."""
    test_seeds: Count = 200
    """Drives of each scenario for the report."""
    seed: Seed = 0
    """Of all drives."""
    time: NotNegative = 0.03
    """Weight of the time to the last waypoint, 1/s."""
    cross_track: NotNegative = 2.0
    """Weight of the RMS distance from the straight lines, 1/m."""
    effort: NotNegative = 0.13
    """Weight of the squared commands, in parts of their limits, over time, 1/s."""
    smoothness: NotNegative = 0.045
    """Weight of the squared changes of the commands from frame to frame."""
    train: _Names = ()
    """Parameters to learn; by default of a car p1, p2, its bound, look-ahead and slowing down in
    turns, of another base its speed, how it slows down, and how fast it turns on the spot."""
    params: OptionalFile = None
    """Where to start: a file of parameters."""
    selector: Believed = "multi-hypothesis"
    steps: Count = 40
    """At most so many."""
    learning_rate: Positive = 0.25
    """Of Adam, at the first step; a tenth of it at the last."""
    out: ResultsFolder = Path("tuned")

    def __post_init__(self) -> None:
        super().__post_init__()
        require(bool(self.test_scenario), "--test-scenario", "names no scenario")
        total = self.time + self.cross_track + self.effort + self.smoothness
        require(total > 0, "--time", "is 0 as all other weights are: there is nothing to lower")
