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
    """Drive a recorded drive again, or localise a recorded camera rig in every frame.

    A drive is a .mcap of `jaxnav`, or a ROS bag with --topics, --rig, --markers-file, --vehicle and
    --route. A .mcap with nothing changed is held against what was recorded, and the exit code is 1
    where it differs.

    A rig is localised in 6 degrees of freedom from a folder with bags and their calibration as
    TagSLAM writes it, a ROS 1 bag with --rig and --markers-file, or an .npz of detections. Where
    there is a reference trajectory the errors against it are measured.

    Written to --out: a TUM trajectory, summary.json, and a PNG where something is to be compared.
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """Drive (.mcap), ROS bag, folder of TagSLAM or .npz."""
    rig: OptionalFile = None
    """Cameras, a rig file or a Kalibr camchain, in place of the recording's own."""
    markers_file: OptionalFile = None
    """Marker map in place of the recording's own."""
    vehicle: OptionalFile = None
    """Vehicle in place of the drive's own."""
    route: OptionalFile = None
    """Waypoints in place of the drive's own."""
    topics: OptionalFile = None
    """Which topic of a ROS bag is what: it is a drive then."""
    images: Switch = False
    """Look for the markers once more in the drive's recorded images."""
    corner_backend: CornerBackend = "aruco"
    """Marker detector, for images. apriltag needs the extra of that name."""
    record: Switch = False
    """Record the drive anew, as replay.mcap."""
    markers: Literal["all", "one-at-a-time"] = "all"
    """One pose from all markers in view, or every marker alone as in the paper."""
    selector: Annotated[
        Selector | None,
        tyro.conf.arg(help_behavior_hint="(default: the drive's, or multi-hypothesis)"),
    ] = None
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
    """Stop after N frames, of a drive after N inputs."""
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
    """Draw a study or a recorded drive.

    Of a study: flip-rate maps, curves with their intervals, reliability diagrams, and summary.json
    with the measures of every cell; if it is not finished, as far as it is. Of a drive (.mcap):
    drive.png, a map with what happened over time, and a summary in the terminal.
    """

    store: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="STORE")]
    """What `jaxnav study` wrote, or a recorded drive (.mcap)."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out")
    """Folder for the pictures."""
    headless: Switch = False
    """No progress bar."""


@dataclass(frozen=True)
class Run:
    """Drive a vehicle through its route.

    Everything is compiled before the vehicle is armed. The last that it hears, however this ends,
    is zero throttle: at the last waypoint, on Ctrl-C and SIGTERM, when data are missing for too
    long, and when anything hangs or fails. `--vehicle sim` is a simulated car in real time;
    `--vehicle replay --option drive=FILE` is a recorded drive, with its own rig, markers, vehicle
    and route.

    Exit codes: 0 arrived, out of time or recording, 1 stopped by the watchdog, 130 and 143 by a
    signal.
    """

    vehicle: str = "sim"
    """An installed vehicle (sim, qcar, ros2, replay and those of plug-ins), or MODULE:NAME."""
    cameras: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="NAME", constructor=str, help_behavior_hint="(default: as --vehicle)"
        ),
    ] = None
    """Installed cameras (sim, qcar, opencv, replay and those of plug-ins), or MODULE:NAME."""
    option: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """What the vehicle and the cameras are told, e.g. images=true for sim."""
    rig: QCarFile = None
    """Cameras: a rig file or a Kalibr camchain."""
    markers: QCarFile = None
    """Marker map."""
    vehicle_file: QCarFile = None
    """Vehicle parameters and limits."""
    route: QCarFile = None
    """Waypoints, and where a simulated car starts."""
    selector: Selector = "multi-hypothesis"
    """Which of the two poses of a marker is believed."""
    corner_backend: CornerBackend = "aruco"
    """Marker detector. apriltag needs the extra of that name."""
    record: Annotated[
        Path | None, tyro.conf.arg(metavar="MCAP", help_behavior_hint="(optional)")
    ] = None
    """Record the drive into this file."""
    record_images: Switch = False
    """Record the cameras' images too, as JPEG."""
    view: Switch = False
    """Open Rerun and look on. Needs the extra viz."""
    duration_s: Annotated[
        float | None,
        tyro.conf.arg(metavar="S", help_behavior_hint="(default: until the last waypoint)"),
    ] = None
    """End after this time, s."""
    period_s: float = 0.02
    """Between two readings of the odometer, s."""
    timeout_s: float = 0.2
    """So long after the last sign of life of any thread the vehicle has been stopped, s."""
    float64: Switch = False
    """Estimate in double precision."""
    seed: int = 0
    """Of a simulated vehicle."""
    headless: Switch = False
    """No status line."""

    def __post_init__(self) -> None:
        _require(self.seed >= 0, "--seed", f"must not be negative, got {self.seed}")
        _require(
            0.002 <= self.period_s <= 0.1,
            "--period-s",
            f"must be from 0.002 to 0.1, got {self.period_s}",
        )
        _require(
            0.1 <= self.timeout_s <= 10,
            "--timeout-s",
            f"must be from 0.1 to 10, got {self.timeout_s}",
        )
        if self.duration_s is not None:
            _require_finite("--duration-s", self.duration_s)
        _require(
            self.record is not None or not self.record_images, "--record-images", "needs --record"
        )


@dataclass(frozen=True)
class Faults:
    """Drive the simulated car with every fault of the fault matrix, and print what came of it.

    Cameras, stamps, odometry, calibration, the world and the loop fail in some fifty ways, one at a
    time, at corner level. Exit code 1 when one of them did not come to what it must.
    """

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="TEXT")] = ()
    """Faults whose names hold one of these."""
    rig: QCarFile = None
    """Cameras: a rig file or a Kalibr camchain."""
    markers: QCarFile = None
    """Marker map."""
    vehicle_file: QCarFile = None
    """Vehicle parameters and limits."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(optional)")] = (
        None
    )
    """Write the table into this file too."""
    float64: Switch = False
    """Estimate in double precision."""
    headless: Switch = False
    """No progress bar."""


@dataclass(frozen=True)
class View:
    """Look at a recorded drive in Rerun: map, cameras, candidates, health, over time.

    Opens a window, or writes an .rrd file to --out. Needs the extra `viz`.
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """Recorded drive (.mcap)."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(optional)")] = (
        None
    )
    """Write this file (.rrd) instead of opening a window."""
    headless: Switch = False
    """No progress bar."""


@dataclass(frozen=True)
class Doctor:
    """Check what a car will run with, and say what to do about each finding.

    Looked at are the computer (packages, OpenCV, JAX, clock, disk), the four files, pictures that
    the car's cameras took while it stood, and the plug-ins, which are opened and read but not
    driven. Exit code 0: no error; 1: an error was found; 2: a file or a flag is not understood.
    """

    rig: QCarFile = None
    """Cameras: a rig file or a Kalibr camchain."""
    markers: QCarFile = None
    """Marker map."""
    vehicle_file: QCarFile = None
    """Vehicle parameters and limits."""
    route: QCarFile = None
    """Start and waypoints."""
    vehicle: Annotated[
        str | None,
        tyro.conf.arg(metavar="NAME", constructor=str, help_behavior_hint="(optional)"),
    ] = None
    """Vehicle plug-in to open and read: an installed name or module:name."""
    cameras: Annotated[
        str | None,
        tyro.conf.arg(metavar="NAME", constructor=str, help_behavior_hint="(optional)"),
    ] = None
    """Camera plug-in to open and read: an installed name or module:name."""
    option: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="KEY=VALUE", help_behavior_hint="(repeatable)"),
    ] = ()
    """What the plug-ins are told."""
    frame: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="CAMERA=IMAGE", help_behavior_hint="(repeatable)"),
    ] = ()
    """A picture by one of the rig's cameras, the car standing anywhere with a marker in view."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(optional)")] = (
        None
    )
    """Write all findings into this file too."""

    def __post_init__(self) -> None:
        for flag, texts in (("--option", self.option), ("--frame", self.frame)):
            expected = "KEY=VALUE" if flag == "--option" else "CAMERA=IMAGE"
            keys = [text.partition("=")[0] for text in texts]
            for text, key in zip(texts, keys, strict=True):
                _require("=" in text and key != "", flag, f"expected {expected}, got {text!r}")
                _require(keys.count(key) == 1, flag, f"{key} is given twice")


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Replay, tyro.conf.subcommand("replay")]
    | Annotated[Locate, tyro.conf.subcommand("locate")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Reliability, tyro.conf.subcommand("reliability")]
    | Annotated[Study, tyro.conf.subcommand("study")]
    | Annotated[Plot, tyro.conf.subcommand("plot")]
    | Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Faults, tyro.conf.subcommand("faults")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)
COMMANDS = {
    "demo": Demo,
    "replay": Replay,
    "locate": Locate,
    "simulate": Simulate,
    "reliability": Reliability,
    "study": Study,
    "plot": Plot,
    "run": Run,
    "faults": Faults,
    "view": View,
    "doctor": Doctor,
}


def _require(condition: bool, flag: str, problem: str) -> None:
    if not condition:
        raise BadInput(flag, problem)


def _require_finite(flag: str, value: float, zero_allowed: bool = False) -> None:
    large_enough = value >= 0 if zero_allowed else value > 0
    bound = "not be negative" if zero_allowed else "be positive"
    _require(math.isfinite(value) and large_enough, flag, f"must {bound} and finite, got {value}")
