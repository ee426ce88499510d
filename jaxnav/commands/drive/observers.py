"""Observers of `jaxnav run`: the recording, Rerun's window, the delay watch, the status line.

None of them waits for a disk or a screen: see `Observer`.
"""

import math
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from jaxnav.commands.drive.arguments import Run
from jaxnav.commands.drive.delay_watch import DelayWatch
from jaxnav.commands.drive.learnt_watch import LearntWatch
from jaxnav.core.models.origin import ZERO
from jaxnav.core.models.vehicle import Vehicle
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import Frame
from jaxnav.drive.loop import Observer
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.errors import Containment
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.recorder import Recorder

if TYPE_CHECKING:
    from jaxnav.pictures.rerun.view import RerunView

WIDTH = 100  # characters, at most
_WIDEST_NAME = 14  # of a health
_FAR = 12  # of a coordinate to the cm, 10 000 km from zero
_STATUS_NS = 200_000_000
_MARKER_NS = 200_000_000  # a marker counts as seen for this long


class Onlooker(Observer, Protocol):
    """An observer that a command closes after the drive, and that then sums up in a line."""

    def close(self) -> None:
        """End its work."""
        ...

    @property
    def closing_note(self) -> str | None:
        """A summary to print; None without one."""
        ...


def open_onlookers(args: Run, setup: DriveSetup, closing: ExitStack) -> list[Onlooker]:
    """Open the observers that the arguments ask for.

    Args:
        closing: closes them in the end.

    Raises:
        BadInput: the file can't be written, Rerun is missing or its window does not open.
    """
    onlookers: list[Onlooker] = []

    def add(onlooker: Onlooker) -> None:
        closing.callback(Containment().of(f"{type(onlooker).__name__}.close", onlooker.close))
        onlookers.append(onlooker)

    if args.record is not None:
        add(DriveRecorder(args.record, setup, args.record_images))
    if args.view:
        from jaxnav.pictures.rerun.view import RerunView  # imports all that draws

        waypoints_m = np.asarray(setup.route_on_map.waypoints_m, float)
        add(LiveView(RerunView(setup.rig, setup.markers, waypoints_m, live=True, save=None)))
    if isinstance(setup.vehicle, Vehicle):  # it knows the motion of a car alone
        add(DelayWatch(setup, warns=not args.headless))
    add(LearntWatch(setup, tells=not args.headless))
    if not args.headless:
        add(StatusLine())
    return onlookers


def closing_notes(onlookers: Iterable[Onlooker], contained: Containment) -> Iterator[str]:
    """What closed onlookers sum up, and in the end what they have raised.

    Args:
        contained: of what they have raised, and raise now.
    """
    for onlooker in onlookers:
        name = f"{type(onlooker).__name__}.closing_note"
        note = contained.of(name, lambda one: one.closing_note)(onlooker)
        if note is not None:
            yield note
    if (raised := contained.summary()) is not None:
        yield raised


class DriveRecorder:
    """An observer that records the loop's inputs and outcomes into a file."""

    def __init__(self, path: Path, setup: DriveSetup, images: bool):
        """Args:
        images: whether to record the cameras' images too, as JPEG.

        Raises:
            BadInput: the file can't be written.
        """
        self._recorder = Recorder(path, setup.header())
        self._images = images
        self._path = path
        self._dropped = 0

    @property
    def faults(self) -> Fault:
        """Faults of the recording: messages dropped since the last call, or that it has failed."""
        faults = Fault(0)
        if self._recorder.dropped > self._dropped:
            self._dropped, faults = self._recorder.dropped, Fault.RECORDER_BEHIND
        return faults | Fault.RECORDER_FAILED if self._recorder.failed else faults

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        """See `Observer`."""
        self._recorder.record(given, outcome)

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        """See `Observer`."""
        if self._images and frame.image is not None:
            self._recorder.image(f"/camera/{name}", frame.stamp_ns, frame.image)

    def close(self) -> None:
        """See `Onlooker`. A drive without a message leaves no file."""
        self._recorder.close(keep_empty=False)

    @property
    def closing_note(self) -> str:
        """See `Onlooker`."""
        text = f"recorded {self._recorder.written} messages in {self._path}"
        if self._recorder.dropped:
            text += f", {self._recorder.dropped} left out"
        return f"{text}; {self._recorder.failed}" if self._recorder.failed else text


class LiveView:
    """An observer that shows outcomes in Rerun's window; a closed window is no fault."""

    faults = Fault(0)

    def __init__(self, view: "RerunView"):
        """Args:
        view: a live view.
        """
        self._view = view

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        """See `Observer`."""
        self._view.show(outcome)

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        """See `Observer`."""
        detections = sighted.detections
        corners_px = None if detections is None else detections.corners_px
        self._view.image(name, frame.stamp_ns, frame.image, corners_px)

    def close(self) -> None:
        """See `Onlooker`."""
        self._view.close()

    @property
    def closing_note(self) -> str | None:
        """See `Onlooker`."""
        if self._view.failed:
            return f"view: {self._view.failed}"
        left_out = self._view.dropped
        return f"view: {left_out} outcomes and images left out" if left_out else None


class StatusLine:
    """An observer that writes one line in the terminal, five times a second."""

    faults = Fault(0)
    closing_note: str | None = None

    def __init__(self) -> None:
        self._last_ns, self._count, self._marker_ns = 0, 0, 0
        self._faults = Fault(0)

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        """See `Observer`."""
        self._count += 1
        if outcome.data is not None and outcome.data.corners_px is not None:
            self._marker_ns = given.now_ns
        if outcome.faults != self._faults:
            text, self._faults = notice(outcome, self._faults), outcome.faults
            if text is not None:
                sys.stderr.write(f"\r{text:<{WIDTH}}\n")
        elapsed_ns = given.now_ns - self._last_ns
        if elapsed_ns < _STATUS_NS:
            return
        line = status_line(
            outcome,
            rate_hz=self._count / (elapsed_ns / 1e9),
            latency_ms=(given.now_ns - outcome.stamp_ns) / 1e6,
            marker_seen=given.now_ns - self._marker_ns < _MARKER_NS,
        )
        sys.stderr.write(f"\r{line:<{WIDTH}}")
        sys.stderr.flush()
        self._last_ns, self._count = given.now_ns, 0

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        """See `Observer`."""

    def close(self) -> None:
        """See `Onlooker`."""
        if self._last_ns:
            sys.stderr.write("\n")


def status_line(outcome: Outcome, rate_hz: float, latency_ms: float, marker_seen: bool) -> str:
    """Rate, latency, health, marker, flip probability, position, command: at most 100 characters.

    The command of a car is throttle and steering, that of another base m/s ahead and to the left
    and degrees a second.

    Far from the world's origin a position takes up more of them, and the units are left out.

        30 Hz   4.2 ms OK             marker flip  0.1% x  1.83 y -0.79 m 124 deg thr  0.037 ...

    Every column has its place, so that the eye finds it again in the next line. A number that does
    not fit its column is shown as `#`, one that is not finite as `?`, and no pose yet as `-`.

    Args:
        rate_hz: of the outcomes or frames that the caller counts.
        latency_ms: from an exposure to its command.
        marker_seen: whether a marker was seen lately.
    """
    output, far = outcome.output, outcome.origin_m != ZERO
    x_m, y_m, psi_rad = (float(value) for value in outcome.pose)
    width = _FAR if far else 6
    places = [_fixed(x_m, width, 2), _fixed(y_m, width, 2), _fixed(math.degrees(psi_rad), 4, 0)]
    x, y, psi = places if bool(output.located) else [f"{'-':>{len(place)}}" for place in places]
    flip = _fixed(100 * float(output.flip_probability), 5, 1)
    gap, m, deg = ("", "", "") if far else (" ", " m", " deg")
    return " ".join(
        (
            f"{_fixed(rate_hz, 4, 0)}{gap}Hz",
            f"{_fixed(latency_ms, 5, 1)}{gap}ms",
            f"{outcome.health.name:<{_WIDEST_NAME}}",
            "marker" if marker_seen else "  --  ",
            f"flip{flip}%",
            f"x{x} y{y}{m}{psi}{deg}",
            *_command(outcome, deg),
        )
    )


def _command(outcome: Outcome, deg: str) -> tuple[str, ...]:
    if outcome.twist is None:
        return (
            f"thr {_fixed(outcome.throttle, 6, 3)}",
            f"str {_fixed(math.degrees(outcome.steering_rad), 5, 1)}{deg}",
        )
    forward_mps, left_mps, turn_radps = outcome.twist
    places = _fixed(forward_mps, 5, 2), _fixed(left_mps, 5, 2)
    return "go", *places, _fixed(math.degrees(turn_radps), 6, 1)


def _fixed(value: float, width: int, decimals: int) -> str:
    """A number in exactly `width` characters, `#` or `?` where it can't be shown."""
    if not math.isfinite(value):
        return f"{'?':>{width}}"
    shown = f"{value:{width}.{decimals}f}"
    return shown if len(shown) <= width else "#" * width


def notice(outcome: Outcome, before: Fault) -> str | None:
    """A notice of faults that a person should hear of as they begin; None without one.

    Args:
        before: the faults of the outcome before.
    """
    new = outcome.faults & ~before
    reasons = []
    if Fault.RELOCATED in new:
        reasons.append(f"not where its wheels can have brought it: {outcome.restart_reason}")
    if Fault.WAYS_DISPUTED in new:
        reasons.append(
            "corners and odometer tell of different ways: a marker moves, or wheels slip"
        )
    if Fault.ODOMETRY_DOUBTFUL in new:
        commanded = "throttle" if outcome.twist is None else "command"
        reasons.append(f"no marker in view, and the odometer contradicts the {commanded}")
    if Fault.GYRO_INVALID in new:
        told = "not finite, at its limit, repeated or noise"
        reasons.append(f"the gyro's readings are {told}: left out")
    if Fault.GYRO_CONTRADICTED in new:
        reasons.append("the gyro contradicts wheels and corners: left out")
    parts = {
        Fault.DRIVE_CONTRADICTED: "throttle" if outcome.twist is None else "ahead",
        Fault.SIDEWAYS_CONTRADICTED: "to the left",
        Fault.TURN_CONTRADICTED: "steering" if outcome.twist is None else "turn",
    }
    wrong = ", ".join(name for part, name in parts.items() if part in new)
    if wrong:
        reasons.append(f"it does not move as it is told ({wrong}): reversed, dead or miswired")
    if Fault.LEFT_ROUTE in new:
        reasons.append("farther from its route than leave_m: it stands")
    if Fault.GYRO_STALE in new and Fault.ODOMETRY_STALE not in outcome.faults:
        reasons.append("the gyro tells nothing: the drive goes on without it")
    if Fault.MARKER_OUTVOTED in new and outcome.outvoted:
        ids = ", ".join(map(str, outcome.outvoted))
        reasons.append(f"marker {ids} is not where the others say: left out")
    if Fault.CAMERA_OUTVOTED in new and outcome.outvoted_cameras:
        cameras = ", ".join(outcome.outvoted_cameras)
        reasons.append(f"the camera {cameras} does not see markers where another does: left out")
    return "; ".join(reasons) or None
