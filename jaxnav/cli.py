"""The command line: `jaxnav demo`, `simulate`, `replay`, `locate`, `reliability`.

A dataclass is a command and its field docstrings are the help. What a command does lies in
`jaxnav.commands` and is imported when the command runs, so that `--help` stays instant.

Exit codes: 0 done, 2 bad input or usage (one line on stderr), 130 interrupted.
"""

import contextlib
import importlib
import io
import math
import os
import platform
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxnav.errors import BadInput

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells report it
EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE

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


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Replay, tyro.conf.subcommand("replay")]
    | Annotated[Locate, tyro.conf.subcommand("locate")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Reliability, tyro.conf.subcommand("reliability")]
)
COMMANDS = {
    "demo": Demo,
    "replay": Replay,
    "locate": Locate,
    "simulate": Simulate,
    "reliability": Reliability,
}
DESCRIPTION = (
    "Localise and drive a vehicle with one square marker and several cameras. "
    "`jaxnav COMMAND --help` explains a command, `jaxnav --version` prints the version."
)


class UsageError(Exception):
    """The command line itself is wrong; the message is one line."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code of the process.

    Args:
        argv: the arguments after the program's name, by default those of the process.
    """
    args = list(sys.argv[1:] if argv is None else argv)
    name = f"jaxnav {args[0]}" if args and args[0] in COMMANDS else "jaxnav"
    try:
        code = _dispatch(args)
        # A closed pipe shows itself on flushing: here it can still be handled.
        sys.stdout.flush()
    except (BadInput, UsageError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The interpreter flushes again when it exits; give it something to flush into.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    return code


def configure_jax(float64: bool) -> None:
    """Choose the precision of this process and keep compiled code between runs.

    For commands, before they build an array: the library itself configures nothing. The cache lies
    in $XDG_CACHE_HOME/jaxnav (~/.cache/jaxnav), in a folder of this machine and jaxlib; where that
    can't be written there is none. $JAX_COMPILATION_CACHE_DIR goes first.
    """
    import jax
    import jaxlib

    jax.config.update("jax_enable_x64", float64)
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    # Compiled code is run as it is found: it must come from this jaxlib, this machine, this user.
    host = f"jaxlib-{jaxlib.__version__}-{platform.machine()}-{platform.node()}"
    try:
        directory = _cache_home() / "jaxnav" / host
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return
    if os.access(directory, os.W_OK | os.X_OK):
        jax.config.update("jax_compilation_cache_dir", str(directory))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _cache_home() -> Path:
    # The XDG specification: a relative path is invalid and to be ignored.
    configured = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return configured if configured.is_absolute() else Path.home() / ".cache"


def _dispatch(args: list[str]) -> int:
    if args == ["--version"]:
        from jaxnav import __version__

        print(f"jaxnav {__version__}")
        return 0
    command = _parse(args)
    if command is None:
        return 0
    module = importlib.import_module(f"jaxnav.commands.{type(command).__name__.lower()}")
    code: int = module.run(command)
    return code


def _parse(args: list[str]) -> Demo | Replay | Locate | Simulate | Reliability | None:
    """The command, or None where help was asked for and printed."""
    messages = io.StringIO()
    wide = not {"-h", "--help"} & set(args)
    try:
        with (
            contextlib.redirect_stderr(messages),
            _unwrapped() if wide else contextlib.nullcontext(),
        ):
            command: Demo | Replay | Locate | Simulate | Reliability = tyro.cli(
                Command,
                prog="jaxnav",
                description=DESCRIPTION,
                args=args,
            )
            return command
    except SystemExit as finished:
        if not finished.code:
            return None
    raise UsageError(_one_line(messages.getvalue()))


@contextlib.contextmanager
def _unwrapped() -> Iterator[None]:
    """Let tyro print long lines whole, so that no path in a message is broken in two."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "100000"
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before


def _one_line(box: str) -> str:
    """What tyro's box of an error says, without its frame and the help it repeats.

    Options stand indented by 4, their help texts deeper.
    """
    sections: list[list[str]] = [[]]
    for framed in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines()[1:-1]:
        line = framed[2:-2].rstrip()
        if set(line) <= {"─", "-"}:
            sections.append([])
        elif not line.startswith(" " * 5):
            sections[-1].append(line)
    told = (
        lines for lines in sections if lines and not lines[0].startswith(("For full", "Argument"))
    )
    text = " ".join("; ".join(_listed(lines) for lines in told).split())
    return re.sub(r"^Error parsing ([A-Z]\w*: )?", "", text) or "wrong usage"


def _listed(lines: list[str]) -> str:
    head = " ".join(line for line in lines if not line.startswith(" "))
    items = ", ".join(line.strip() for line in lines if line.startswith(" "))
    return f"{head} {items}".strip()


def _require(condition: bool, flag: str, problem: str) -> None:
    if not condition:
        raise BadInput(flag, problem)


def _require_finite(flag: str, value: float, zero_allowed: bool = False) -> None:
    large_enough = value >= 0 if zero_allowed else value > 0
    bound = "not be negative" if zero_allowed else "be positive"
    _require(math.isfinite(value) and large_enough, flag, f"must {bound} and finite, got {value}")
