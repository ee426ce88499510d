"""Arguments of the commands that drive a car or check it, or read a recording or a photograph."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from annotated_types import Gt, Interval

from jaxnav.commands import kinds
from jaxnav.commands.kinds import key_values, optional, require

# What a loop can keep.
_Period = Annotated[
    float,
    Interval(ge=0.002, le=0.1),
    tyro.conf.arg(help="Between two readings of the odometer, s."),
]
_Timeout = Annotated[
    float,
    Interval(ge=0.1, le=10),
    tyro.conf.arg(
        help="So long after the last sign of life of any thread the vehicle has been stopped, s."
    ),
]


@dataclass(frozen=True)
class Run:
    """Drive a vehicle through its route.

    The vehicle is what its file says: a car, or a base that is driven by a twist. Everything is
    compiled before it is armed. The last that it hears, however this ends, is zero throttle, or a
    twist of zero: at the last waypoint, on Ctrl-C, Ctrl-Z and any other signal, when data are
    missing for too long, and when anything hangs, fails or is killed. A vehicle that can be moved
    is opened in a small process of its own, which stops it whatever becomes of this one; others,
    `sim` and `replay` among them, are watched by a thread. `--car sim` is a simulated car in
    real time; `--car replay --option drive=FILE` is a recorded drive, with its own rig,
    markers, vehicle and route.

    Exit codes: 0 arrived, out of time or recording, 1 stopped by a guard, 2 bad input, 128 plus the
    number of the signal that ended it: 130 Ctrl-C, 143 SIGTERM, 129 a closed terminal, 131 SIGQUIT,
    148 Ctrl-Z.
    """

    car: str = "sim"
    """An installed vehicle (sim, qcar, ros2, replay and those of plug-ins), or MODULE:NAME."""
    cameras: Annotated[str | None, optional("NAME", "(default: as --car)", str)] = None
    """Installed cameras (sim, qcar, opencv, replay and those of plug-ins), or MODULE:NAME."""
    option: kinds.KeyValues = ()
    """What the vehicle and the cameras are told, e.g. images=true for sim."""
    rig: kinds.QCarRig = None
    markers: kinds.QCarMarkers = None
    vehicle: kinds.QCarVehicle = None
    route: kinds.QCarFile = None
    """Waypoints, and where a simulated car starts."""
    params: kinds.OptionalFile = None
    """Tuned parameters of filter and controller."""
    selector: kinds.Believed = "multi-hypothesis"
    corner_backend: kinds.Detector = "aruco"
    detector: kinds.Following = "follow"
    relocate: bool = True
    """Drive on, slowly at first, where the corners say that the car is where its wheels can't have
    brought it: somebody carried it there, or shows it a copy of the marker. Without: stop."""
    record: Annotated[Path | None, optional("MCAP")] = None
    """Record the drive into this file."""
    record_images: kinds.Switch = False
    """Record the cameras' images too, as JPEG."""
    view: kinds.Switch = False
    """Open Rerun and look on. Needs the extra viz."""
    duration_s: Annotated[
        kinds.Positive | None, optional("S", "(default: until the last waypoint)")
    ] = None
    """End after this time, s."""
    period_s: _Period = 0.02
    timeout_s: _Timeout = 0.2
    float64: kinds.Float64 = False
    seed: kinds.Seed = 0
    """Of a simulated vehicle."""
    headless: kinds.Switch = False
    """No status line."""

    def __post_init__(self) -> None:
        recorded = self.record is not None or not self.record_images
        require(recorded, "--record-images", "needs --record")


@dataclass(frozen=True)
class Stop:
    """Tell a vehicle to stop that nobody drives any more.

    For a service manager (`ExecStopPost`), after both processes of `jaxnav run` were killed at
    once. Says stop for up to 10 s, until the vehicle has heard it.

    Exit codes: 0 it has heard, 1 it has not, 2 bad input.
    """

    car: str
    """As `jaxnav run` was told: an installed vehicle, or MODULE:NAME."""
    option: kinds.KeyValues = ()
    """What the vehicle is told, as by `jaxnav run`."""
    vehicle: kinds.QCarVehicle = None


@dataclass(frozen=True)
class Ros:
    """Localise and drive as a lifecycle node of ROS 2, named jaxnav.

    FILE says which topic is what and names our files. With a route the node drives a car or another
    base, through the guard that `jaxnav run` has; without one it localises a vehicle that somebody
    else drives; without a vehicle, a rig that moves freely. It sends tf, pose with covariance,
    odometry, all hypotheses, diagnostics.

    Exit codes: 1 the drive has ended, 2 bad input, 128 plus the number of the signal that ended it.
    """

    file: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="FILE")] = None
    """The node's YAML; left out, the node's parameter `file` names it."""
    managed: kinds.Switch = False
    """Wait for the transitions configure and activate, instead of starting at once."""
    record: Annotated[Path | None, optional("MCAP")] = None
    """Record the drive into this file; after a reset, the next one into FILE_2.mcap."""
    bag: kinds.OptionalFile = None
    """Take the messages of this bag of ROS 1 or 2, as `jaxnav replay` does, and send what comes of
    them and /clock; no vehicle hears a command."""
    rate: Annotated[float, Gt(0)] = 1.0
    """How fast the bag is played, times real time; inf is as fast as it goes."""
    corner_backend: kinds.Detector = "aruco"
    detector: kinds.Following = "follow"
    period_s: _Period = 0.02
    timeout_s: _Timeout = 0.2
    float64: kinds.Float64 = False
    ros_args: Annotated[tuple[str, ...], tyro.conf.arg(metavar="WORDS")] = ()
    """Words for ROS itself, last on the line: --ros-args -p use_sim_time:=true."""


@dataclass(frozen=True)
class Faults:
    """Drive the simulated vehicle with every fault of the fault matrix, and print what came of it.

    Cameras, stamps, odometry, actuators, calibration, the world and the loop fail in some ninety
    ways, one at a time, at corner level; another base than a car is tried in fewer. Exit code 1
    when one of them did not come to what it must.
    """

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="TEXT")] = ()
    """Faults whose names hold one of these."""
    rig: kinds.QCarRig = None
    markers: kinds.QCarMarkers = None
    vehicle: kinds.QCarVehicle = None
    json: kinds.OptionalFile = None
    """Write the table into this file too."""
    float64: kinds.Float64 = False
    headless: kinds.Headless = False


@dataclass(frozen=True)
class ReplayRecording:
    """Drive a recorded drive again, or localise a recorded camera rig in every frame.

    A drive is a .mcap of `jaxnav`, or a ROS bag with --topics, --rig, --markers, --vehicle and
    --route. A .mcap with nothing changed is held against what was recorded, and the exit code is 1
    where it differs.

    A rig is localised in 6 degrees of freedom from a folder with bags and their calibration as
    TagSLAM writes it, a ROS 1 bag with --rig and --markers, an .npz of detections, or any ROS bag
    with --rig, --markers and a --topics that has an IMU. Where there is a reference trajectory the
    errors against it are measured.

    Written to --out: a TUM trajectory, summary.json, and a PNG where something is to be compared.
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """Drive (.mcap), ROS bag, folder of TagSLAM or .npz."""
    rig: kinds.OptionalFile = None
    """Cameras, a rig file or a Kalibr camchain, in place of the recording's own."""
    markers: kinds.OptionalFile = None
    """Marker map in place of the recording's own."""
    vehicle: kinds.OptionalFile = None
    """Vehicle in place of the drive's own."""
    route: kinds.OptionalFile = None
    """Waypoints in place of the drive's own."""
    params: kinds.OptionalFile = None
    """Tuned parameters, of a drive in place of all of its own; --corner-sigma-px goes before."""
    topics: kinds.OptionalFile = None
    """Which topic of a ROS bag is what: it is a drive then, or with an IMU a rig's recording."""
    images: kinds.Switch = False
    """Look for the markers once more in the drive's recorded images."""
    corner_backend: kinds.CornerBackend = "aruco"
    """Marker detector, for images. apriltag needs the extra of that name."""
    record_anew: kinds.Switch = False
    """Record the drive anew, as replay.mcap."""
    one_at_a_time: kinds.Switch = False
    """A pose from every marker alone, as in the paper, instead of one from all in view."""
    selector: Annotated[
        kinds.Selector | None,
        tyro.conf.arg(help_behavior_hint="(default: the drive's, or multi-hypothesis)"),
    ] = None
    """Which of the two poses of a marker is believed."""
    corner_sigma_px: Annotated[
        kinds.CornerSigma | None, optional("PX", "(default: as the recording tells)")
    ] = None
    """Standard deviation of a corner coordinate."""
    without_odometry: kinds.Switch = False
    """Localise a rig by its cameras alone, also where an IMU or odometry is recorded."""
    smooth: kinds.Switch = False
    """Tell each pose what was seen after it as well as before, both branches weighed over all of
    it; the trajectory goes on where no marker is seen. Of a drive it is smoothed.tum."""
    limit: Annotated[kinds.Count | None, optional("N", "(default: all)", int)] = None
    """Stop after N frames, of a drive after N inputs."""
    out: kinds.ResultsFolder = Path("out")
    headless: kinds.Headless = False


@dataclass(frozen=True)
class ViewDrive:
    """Look at a recorded drive in Rerun: map, cameras, candidates, health, over time.

    Opens a window, or writes an .rrd file to --out. Needs the extra `viz`.
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """Recorded drive (.mcap)."""
    out: kinds.OptionalFile = None
    """Write this file (.rrd) instead of opening a window."""
    headless: kinds.Headless = False


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
    headless: kinds.Headless = False


@dataclass(frozen=True)
class Locate:
    """Find markers in a photograph and print both poses of each.

    With each marker: reprojection errors, their ratio, the probability that the better pose is
    the mirrored one, and sigma; notes on what does not add up. No marker in view is a result and
    not an error.
    """

    image: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGE")]
    """Photograph, in any format that OpenCV reads, or HEIC; not turned by its EXIF orientation."""
    camera: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Calibration: a rig file, a Kalibr camchain or a ROS camera_info YAML."""
    marker_size_m: Annotated[kinds.SizeM, tyro.conf.arg(metavar="S")]
    """Side of the black square, m."""
    camera_name: kinds.OptionalName = None
    """Which camera of the file took it, where the file holds several."""
    family: str = "tag36h11"
    """Marker family."""
    corner_backend: kinds.Detector = "aruco"
    as_json: kinds.Switch = False
    """Print JSON instead of a table."""
    out: Annotated[Path | None, optional("FILE")] = None
    """Draw the markers and both poses into this file, .png or .jpg, as large as the photograph."""


@dataclass(frozen=True)
class Doctor:
    """Check what a car will run with, and say what to do about each finding.

    Looked at are the computer (packages, OpenCV, JAX, clock, disk), the four files, pictures that
    the car's cameras took while it stood, and the plug-ins, which are opened and read but not
    driven. Exit code 0: no error; 1: an error was found; 2: a file or a flag is not understood.
    """

    rig: kinds.QCarRig = None
    markers: kinds.QCarMarkers = None
    vehicle: kinds.QCarVehicle = None
    route: kinds.QCarFile = None
    """Start and waypoints."""
    car: kinds.OptionalName = None
    """Vehicle plug-in to open and read: an installed name or module:name."""
    cameras: kinds.OptionalName = None
    """Camera plug-in to open and read: an installed name or module:name."""
    option: kinds.KeyValues = ()
    """What the plug-ins are told."""
    frame: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], optional("CAMERA=IMAGE", "(repeatable)")
    ] = ()
    """A picture by one of the rig's cameras, the car standing anywhere with a marker in view."""
    drive: Annotated[Path | None, optional("FILE.mcap")] = None
    """A recorded drive with eights, or stops and starts: are the cameras later than they say?"""
    json: kinds.OptionalFile = None
    """Write all findings into this file too."""

    def __post_init__(self) -> None:
        key_values("--option", self.option)
        key_values("--frame", self.frame, "CAMERA=IMAGE")
