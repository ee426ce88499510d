"""What the commands of `jaxnav` can be told: a dataclass each; its fields' docstrings are the help.

Values that no file is needed to judge are judged here.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxnav.errors import BadInput

Selector = Literal[
    "multi-hypothesis",
    "lowest-reprojection",
    "ratio-test",
    "object-space",
    "paper-cost",
    "mahalanobis",
]
# These need what only a simulation has: another sensor, the truth.
SimulatedSelector = Literal[Selector, "orientation-given", "oracle", "all"]
Scenario = Literal[
    "paper",
    "static",
    "approach",
    "orbit",
    "tunnel",
    "kidnapped",
    "slip",
    "miscalibrated",
    "blur",
]
StudyKind = Literal["ambiguity", "drive"]
CornerBackend = Literal["aruco", "apriltag"]
Switch = tyro.conf.FlagCreatePairsOff[bool]
QCarFile = Annotated[
    Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: the QCar's)")
]
OptionalFile = Annotated[
    Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(optional)")
]


@dataclass(frozen=True)
class Demo:
    """Drive the paper's experiment: a simulated car, four rendered cameras, one marker.

    The car is driven by the method of --selector alone; Method A (the pose of lowest reprojection
    error) with the same filter runs alongside on the same frames. Written to --out: report.png,
    a mosaic of camera frames, summary.json, and trajectories in TUM format.
    """

    seed: int = 0
    """Seed of every random number: first belief, image noise, odometry noise."""
    seeds: int = 1
    """Drive this many times, with seeds counting up from --seed, and print the success rates."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("demo")
    """Folder for the report."""
    selector: Selector = "multi-hypothesis"
    """Which of the two poses of a marker the driving method believes."""
    rig: QCarFile = None
    """Cameras: a rig file or a Kalibr camchain."""
    markers: QCarFile = None
    """Marker map."""
    vehicle: QCarFile = None
    """Vehicle parameters and limits."""
    route: QCarFile = None
    """Start and waypoints."""
    blur: bool = True
    """Integrate each image over its exposure while the car moves."""
    exposure_ms: float = 10.0
    """Exposure time, ms."""
    corner_noise_px: float = 0.0
    """Spoil the detected corners by this much (standard deviation, px)."""
    rolling_shutter: bool = True
    """Expose the rows of an image one after the other."""
    corner_backend: CornerBackend = "aruco"
    """Marker detector. apriltag needs the extra of that name."""
    duration_s: float = 30.0
    """Give up when the car has not arrived after this simulated time, s."""
    headless: Switch = False
    """No progress bar."""

    def __post_init__(self) -> None:
        _require(self.seed >= 0, "--seed", f"must not be negative, got {self.seed}")
        _require(self.seeds >= 1, "--seeds", f"must be at least 1, got {self.seeds}")
        _require_finite("--exposure-ms", self.exposure_ms, zero_allowed=True)
        _require_finite("--corner-noise-px", self.corner_noise_px, zero_allowed=True)
        _require_finite("--duration-s", self.duration_s)


@dataclass(frozen=True)
class Replay:
    """Localise a recorded camera rig in every frame, in 6 degrees of freedom.

    RECORDING is a folder with bags and their calibration as TagSLAM writes it, a bag alone with
    --rig and --markers-file, or an .npz of detections. Where it holds a reference trajectory the
    errors against it are measured. Written to --out: a TUM trajectory, a PNG and summary.json.
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """Folder, ROS 1 bag (.bag, .bag.bz2) or .npz."""
    rig: OptionalFile = None
    """Cameras, a rig file or a Kalibr camchain, in place of the recording's own."""
    markers_file: OptionalFile = None
    """Marker map in place of the recording's own."""
    markers: Literal["all", "one-at-a-time"] = "all"
    """One pose from all markers in view, or every marker alone as in the paper."""
    selector: Selector = "multi-hypothesis"
    """Which of the two poses of a marker is believed."""
    corner_sigma_px: Annotated[
        float | None,
        tyro.conf.arg(metavar="PX", help_behavior_hint="(default: as the recording tells)"),
    ] = None
    """Standard deviation of a corner coordinate."""
    limit: Annotated[
        int | None,
        tyro.conf.arg(metavar="N", constructor=int, help_behavior_hint="(default: all)"),
    ] = None
    """Stop after N frames."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out")
    """Folder for the results."""
    headless: Switch = False
    """No progress bar."""

    def __post_init__(self) -> None:
        if self.limit is not None:
            _require(self.limit >= 1, "--limit", f"must be at least 1, got {self.limit}")
        if self.corner_sigma_px is not None:
            _require_finite("--corner-sigma-px", self.corner_sigma_px)


@dataclass(frozen=True)
class Locate:
    """Find markers in a photograph and print both poses of each.

    With each marker: reprojection errors, their ratio, the probability that the better pose is
    the mirrored one, and sigma. No marker in view is a result and not an error.
    """

    image: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGE")]
    """Photograph, in any format that OpenCV reads."""
    camera: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Calibration: a rig file, a Kalibr camchain or a ROS camera_info YAML."""
    marker_size_m: Annotated[float, tyro.conf.arg(metavar="S")]
    """Side of the black square, m."""
    camera_name: Annotated[
        str | None,
        tyro.conf.arg(metavar="NAME", constructor=str, help_behavior_hint="(optional)"),
    ] = None
    """Which camera of the file took it, where the file holds several."""
    family: str = "tag36h11"
    """Marker family."""
    corner_backend: CornerBackend = "aruco"
    """Marker detector. apriltag needs the extra of that name."""
    json: Switch = False
    """Print JSON instead of a table."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="PNG", help_behavior_hint="(optional)")] = (
        None
    )
    """Draw the markers and both poses into this file."""

    def __post_init__(self) -> None:
        _require_finite("--marker-size-m", self.marker_size_m)


@dataclass(frozen=True)
class Simulate:
    """Drive many seeds at corner level, without images, and count what became of them.

    Prints a table, one row for each selector and noise level. A drive succeeds when the true car
    has passed within 0.30 m of every waypoint in order, in 40 s, without leaving the 5 x 5 m
    floor; parked, when its last pose is not the wrong one. A pose is wrong when its heading is off
    by more than 20 degrees. Position error and ANEES (3 degrees of freedom) are those of poses that
    are decided.
    """

    scenario: Scenario = "paper"
    """What happens: the paper's drive, or one with trouble in it."""
    selector: tuple[SimulatedSelector, ...] = ("multi-hypothesis",)
    """Which pose is believed; several names, or `all`."""
    corner_noise_px: tuple[float, ...] = (1.0,)
    """Standard deviation of the corners, one or several."""
    told_noise_px: Annotated[
        float | None, tyro.conf.arg(metavar="PX", help_behavior_hint="(default: the truth)")
    ] = None
    """What the navigator is told of it."""
    seeds: int = 100
    """How many drives."""
    seed: int = 0
    """The first seed."""
    rig: QCarFile = None
    """Cameras: a rig file or a Kalibr camchain."""
    markers: QCarFile = None
    """Marker map."""
    vehicle: QCarFile = None
    """Bicycle parameters and limits."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(optional)")] = (
        None
    )
    """Write all numbers, each with its 95 % interval, into this file after every row."""
    resume: Switch = False
    """Keep the rows that --json holds already."""
    headless: Switch = False
    """No progress bar."""

    def __post_init__(self) -> None:
        _require(self.seeds >= 1, "--seeds", f"must be at least 1, got {self.seeds}")
        _require(self.seed >= 0, "--seed", f"must not be negative, got {self.seed}")
        _require(bool(self.selector), "--selector", "names no selector")
        _require(bool(self.corner_noise_px), "--corner-noise-px", "holds no number")
        for value in self.corner_noise_px:
            _require_finite("--corner-noise-px", value)
        if self.told_noise_px is not None:
            _require_finite("--told-noise-px", self.told_noise_px)
        _require(not self.resume or self.json is not None, "--resume", "needs --json")


@dataclass(frozen=True)
class Reliability:
    """Draw whether flip probabilities mean what they say: when it says 10 %, are 10 % flipped?

    Without RECORDING, on random views of one marker (sides of 10 to 100 px, 0 to 60 degrees, corner
    noise of 0.2 to 2 px), frame by frame. With a RECORDING that has a reference, on its detections,
    every marker by itself. Written to --out: reliability.png and summary.json.
    """

    recording: Annotated[
        tyro.conf.Positional[Path | None],
        tyro.conf.arg(metavar="RECORDING", help_behavior_hint="(optional)"),
    ] = None
    """Folder, ROS 1 bag (.bag, .bag.bz2) or .npz."""
    selector: Selector = "multi-hypothesis"
    """Whose probabilities, on a recording."""
    frames: int = 165_000
    """How many random views."""
    seed: int = 0
    """Of the random views."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out")
    """Folder for the results."""
    headless: Switch = False
    """No progress bar."""

    def __post_init__(self) -> None:
        _require(self.frames >= 1, "--frames", f"must be at least 1, got {self.frames}")
        _require(self.seed >= 0, "--seed", f"must not be negative, got {self.seed}")


@dataclass(frozen=True)
class Study:
    """Run a Monte-Carlo study: a labelled grid of parameters, many trials in every cell.

    `ambiguity` studies single frames, `drive` closed-loop drives. CONFIG is a YAML file, or the
    name of one that comes with jaxnav (`jaxnav study ambiguity list` lists them, and all that can
    vary). The result is a Zarr store that xarray opens. A study that was interrupted or killed goes
    on when the same command is given again, and ends with the same bits.
    """

    kind: tyro.conf.Positional[StudyKind]
    """What a trial is."""
    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CONFIG")]
    """YAML file with `trials`, `axes` and what is fixed; or a name; or `list`."""
    out: Annotated[
        Path | None,
        tyro.conf.arg(metavar="STORE", help_behavior_hint="(default: out/CONFIG.zarr)"),
    ] = None
    """Where the result goes, or goes on."""
    workers: Annotated[
        int | None,
        tyro.conf.arg(metavar="N", constructor=int, help_behavior_hint="(default: this process)"),
    ] = None
    """Start so many Dask workers on this machine."""
    scheduler: Annotated[
        str | None,
        tyro.conf.arg(metavar="ADDRESS", constructor=str, help_behavior_hint="(optional)"),
    ] = None
    """Run on the Dask cluster with its scheduler there, e.g. tcp://127.0.0.1:8786."""
    chunk_trials: Annotated[
        int | None,
        tyro.conf.arg(
            metavar="N", constructor=int, help_behavior_hint="(default: 65536, or 256 drives)"
        ),
    ] = None
    """How many trials are run and written at a time. Changes no result."""
    headless: Switch = False
    """No progress bar."""

    def __post_init__(self) -> None:
        if self.chunk_trials is not None:
            least = f"must be at least 1, got {self.chunk_trials}"
            _require(self.chunk_trials >= 1, "--chunk-trials", least)
        if self.workers is not None:
            _require(self.workers >= 1, "--workers", f"must be at least 1, got {self.workers}")
            _require(self.scheduler is None, "--scheduler", "brings its own workers")


@dataclass(frozen=True)
class Plot:
    """Draw a study: flip-rate maps, curves with their intervals, reliability diagrams.

    Written to --out: PNG files, and summary.json with the measures of every cell. A study that is
    not finished is drawn as far as it is.
    """

    store: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="STORE")]
    """What `jaxnav study` wrote."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out")
    """Folder for the pictures."""
    headless: Switch = False
    """No progress bar."""


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Replay, tyro.conf.subcommand("replay")]
    | Annotated[Locate, tyro.conf.subcommand("locate")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Reliability, tyro.conf.subcommand("reliability")]
    | Annotated[Study, tyro.conf.subcommand("study")]
    | Annotated[Plot, tyro.conf.subcommand("plot")]
)
COMMANDS = {
    "demo": Demo,
    "replay": Replay,
    "locate": Locate,
    "simulate": Simulate,
    "reliability": Reliability,
    "study": Study,
    "plot": Plot,
}


def _require(condition: bool, flag: str, problem: str) -> None:
    if not condition:
        raise BadInput(flag, problem)


def _require_finite(flag: str, value: float, zero_allowed: bool = False) -> None:
    large_enough = value >= 0 if zero_allowed else value > 0
    bound = "not be negative" if zero_allowed else "be positive"
    _require(math.isfinite(value) and large_enough, flag, f"must {bound} and finite, got {value}")
