"""Observers of a drive: its recording, Rerun's window, what it learns, whether cameras are late.
None waits for a disk or a screen: see `Observer`."""

import math
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxnav.core.models.origin import opposite, planar_in_world
from jaxnav.core.models.vehicle import Vehicle
from jaxnav.drive.camera_delays import CameraDelays, Delay
from jaxnav.drive.chassis import chassis_of
from jaxnav.drive.corrections import Corrections
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections, FrameIntake
from jaxnav.drive.interfaces import Frame, Odometry
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.drive.seeing import Search
from jaxnav.errors import Containment, visible
from jaxnav.recordings.drive_log import DriveLog
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.learnt import Learnt, errors_of, repeated_share
from jaxnav.recordings.recorder import Recorder

if TYPE_CHECKING:
    from jaxnav.pictures.rerun.view import RerunView

WIDTH = 100  # characters of a line on the terminal, at most
_PERIOD_NS = 2_000_000_000
_CORNERS = "corners", "repeat"  # what is found of them is written in no file
_TELLS_SHARE = 0.05  # of the corners' variance
_CLOSE_S = 20.0  # the compiler can't be interrupted, and the vehicle already stands
_ADOPT = "`jaxnav calibrate adopt` writes what a recorded drive has learnt into new files"


class DriveObserver:
    """An `Observer` that does nothing yet. It is closed after the drive, and then sums up."""

    @property
    def faults(self) -> Fault:
        """The faults of the observer."""
        return Fault(0)

    @property
    def closing_note(self) -> str | None:
        """A summary to print; None without one."""
        return None

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        """Take an input that the pilot has handled, and its outcome."""

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        """Take a camera's frame after the search for markers, and the markers found."""

    def close(self) -> None:
        """End its work."""


def closing_notes(observers: Iterable[DriveObserver], contained: Containment) -> Iterator[str]:
    """What closed observers sum up, and in the end what they have raised.

    Args:
        contained: of what they have raised, and raise now.
    """
    for observer in observers:
        name = f"{type(observer).__name__}.closing_note"
        note = contained.wrap(name, lambda one: one.closing_note)(observer)
        if note is not None:
            yield note
    if (raised := contained.summary()) is not None:
        yield raised


class DriveRecorder(DriveObserver):
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
        self._recorder.record(given, outcome)

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        if self._images and frame.image is not None:
            self._recorder.image(f"/camera/{name}", frame.stamp_ns, frame.image)

    def close(self) -> None:
        """End the recording; a drive without a message leaves no file."""
        self._recorder.close(keep_empty=False)

    @property
    def closing_note(self) -> str:
        text = f"recorded {self._recorder.written} messages in {self._path}"
        if self._recorder.dropped:
            text += f", {self._recorder.dropped} left out"
        return f"{text}; {self._recorder.failed}" if self._recorder.failed else text


class LiveView(DriveObserver):
    """An observer that shows outcomes in Rerun's window; a closed window is no fault."""

    def __init__(self, view: "RerunView"):
        self._view = view

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        self._view.show(outcome)

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        detections = sighted.detections
        corners_px = None if detections is None else detections.corners_px
        self._view.image(name, frame.stamp_ns, frame.image, corners_px)

    def close(self) -> None:
        self._view.close()

    @property
    def closing_note(self) -> str | None:
        if self._view.failed:
            return f"view: {self._view.failed}"
        left_out = self._view.dropped
        return f"view: {left_out} outcomes and images left out" if left_out else None


class LearntWatch(DriveObserver):
    """Tells once of each error that the drive has learnt."""

    def __init__(self, setup: DriveSetup, tells: bool):
        """Args:
        tells: on the terminal, as soon as it is learnt; in any case in the end.
        """
        # Of NumPy: the driving thread asks no device.
        self._rig, self._vehicle = jax.device_get((setup.rig, setup.vehicle))
        self._adopts = isinstance(setup.vehicle, Vehicle)
        self._tells, self._last_ns = tells, 0
        self._said: set[tuple[str, str]] = set()
        self._found: dict[tuple[str, str], str] = {}

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        if given.now_ns - self._last_ns < _PERIOD_NS or not outcome.output.decided:
            return
        self._last_ns = given.now_ns
        learnt = Learnt.from_errors(*errors_of(outcome.belief.bank), self._rig, self._vehicle)
        self._found = {} if learnt is None else learnt.found()
        share = repeated_share(outcome.belief)
        if share is not None and share >= _TELLS_SHARE:
            self._found[_CORNERS] = (
                f"{share:.0%} of the corners' variance is the same from frame to "
                "frame: the lens model, or a marker that is not flat"
            )
        for subject, sentence in self._found.items():
            if subject not in self._said:
                self._said.add(subject)
                if self._tells:
                    sys.stderr.write(f"\r{f'learnt: {visible(sentence)}':<{WIDTH}}\n")

    @property
    def closing_note(self) -> str | None:
        if not self._found:
            return None
        lines = [f"learnt: {visible(line)}" for line in self._found.values()]
        adopts = self._adopts and self._found.keys() - {_CORNERS}
        return "\n".join([*lines, _ADOPT] if adopts else lines)


class ExposureWatch(DriveObserver):
    """Tells in the end how long cameras expose, by the streaks of markers."""

    def __init__(self, names: Sequence[str], searches: Sequence[Search]):
        self._names, self._searches = tuple(names), tuple(searches)

    @property
    def closing_note(self) -> str | None:
        lines = [
            f"learnt: camera {visible(name)} exposes for {1e3 * exposure_s:.1f} ms, by the streaks "
            f"of markers: `exposure_s: {exposure_s:.2g}` in rig.yaml tells it from the start"
            for name, search in zip(self._names, self._searches, strict=True)
            if search.tracker is not None
            and (exposure_s := search.tracker.learnt_exposure_s) is not None
        ]
        return "\n".join(lines) or None


# --- late cameras --------------------------------------------------------------------------


class DelayWatch(DriveObserver):
    """Warns once when a camera is later than its stamps say.

    Work that takes milliseconds is done in a thread of its own, beside the loop.
    """

    def __init__(self, setup: DriveSetup, warns: bool):
        """Args:
        setup: of a car.
        warns: on the terminal, as soon as a camera is found to be late.
        """
        self._setup, self._warns = setup, warns
        car = setup.car(Path("the drive"))
        self._delays = CameraDelays(setup.rig, setup.markers, car)
        self._faults = Fault(0)
        # What it raises must not end the thread, which nobody would notice.
        self._solve = Containment().wrap("the delay watch", self._delays.solve)
        self._wake, self._closing = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="jaxnav-delays", daemon=True)
        self._thread.start()

    def warm_up(self) -> None:
        """Compile or load what it calls, before the drive."""
        self._delays.warm_up()

    @property
    def faults(self) -> Fault:
        return self._faults

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        self._delays.add_outcome(outcome)
        if self._delays.due:
            self._wake.set()

    def close(self) -> None:
        self._closing = True
        self._wake.set()
        self._thread.join(_CLOSE_S)

    @property
    def closing_note(self) -> str | None:
        return (
            "\n".join(delay_warnings(self._delays, self._setup)) or None if self._faults else None
        )

    def _run(self) -> None:
        while not self._closing:
            self._wake.wait()
            self._wake.clear()
            while self._delays.due and not self._closing:
                self._solve()
            if self._delays.late and not self._faults:
                self._faults = Fault.CAMERA_LATE
                if self._warns:
                    text = "\n".join(delay_warnings(self._delays, self._setup))
                    sys.stderr.write(f"\n{text}\n")


def delay_warnings(delays: CameraDelays, setup: DriveSetup) -> Iterator[str]:
    """A line for each camera whose stamps are surely wrong, or one line for all cameras."""
    camera_delays, together = delays.delays, delays.common_delay
    file_s = Corrections.from_vehicle(setup.vehicle).camera_delay_s
    known = [one for one in camera_delays if one.known]
    agree = all(
        abs(one.delay_s - together.delay_s) < 3 * math.hypot(one.sigma_s, together.sigma_s)
        for one in known
    )
    if together.late and len(known) != 1 and agree:
        delay_s = file_s + together.delay_s
        do = f"set camera_delay_s to {delay_s:.3f} in vehicle.yaml"
        yield f"the cameras are {describe_delay(together)}: {do}"
        return
    for name, one in zip(setup.rig.names, camera_delays, strict=True):
        if not one.late:
            continue
        delay_s = file_s + one.delay_s
        yield (
            f"camera {name!r} is {describe_delay(one)}: "
            f"raise its latency_ms by {one.delay_s * 1e3:.0f}, or "
            f"set camera_delay_s to {delay_s:.3f} in vehicle.yaml where all cameras are like it"
        )


def describe_delay(delay: Delay) -> str:
    """A delay as text: `48 +- 6 ms later than stamps say`."""
    way = "later" if delay.delay_s > 0 else "earlier"
    off_ms, sigma_ms = abs(delay.delay_s) * 1e3, max(delay.sigma_s * 1e3, 1.0)
    return f"{off_ms:.0f} +- {sigma_ms:.0f} ms {way} than stamps say"


def delays_of(log: DriveLog, setup: DriveSetup) -> CameraDelays:
    """The delays of the cameras in the recorded drive of a car."""
    delays = CameraDelays(setup.rig, setup.markers, setup.car(Path("the drive")))
    corrections, chassis = Corrections.from_vehicle(setup.vehicle), chassis_of(setup.vehicle)
    frames = FrameIntake(len(setup.rig), setup.markers, setup.corner_sigma_px)
    outcomes = log.outcomes
    poses = planar_in_world(outcomes.pose, opposite(setup.markers.origin_m))
    known = outcomes.decided & np.isfinite(poses).all(axis=1)
    at = 0
    for given in log.inputs:
        read = given.odometry
        if read is not None and read.valid:
            right = corrections.correct_reading(read)
            if isinstance(right, Odometry) and chassis.reads(right):
                delays.add_reading(right.stamp_ns, right.speed_mps, right.steering_rad)
        seen, stamp_ns, _ = frames.check(
            [corrections.correct_frame(f) for f in given.frames], given.now_ns
        )
        if seen is not None:
            delays.add_corners(stamp_ns, seen)
        while at < len(known) and outcomes.now_ns[at] <= given.now_ns:
            if known[at]:
                delays.add_pose(int(outcomes.now_ns[at]), np.asarray(poses[at], float))
            at += 1
        while delays.due:
            delays.solve()
    return delays
