"""Checks of the cameras' stamps, while a car drives and in a recorded drive."""

import math
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxnav.commands.drive.observers import DriveObserver
from jaxnav.core.models.origin import opposite, planar_in_world
from jaxnav.drive.camera_delays import CameraDelays, Delay
from jaxnav.drive.chassis import chassis_of
from jaxnav.drive.corrections import Corrections
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameIntake
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.errors import Containment
from jaxnav.recordings.drive_log import DriveLog
from jaxnav.recordings.drive_setup import DriveSetup

# The compiler can't be interrupted, and the vehicle already stands.
_CLOSE_S = 20.0


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
        self._solve = Containment().of("the delay watch", self._delays.solve)
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
        return "\n".join(warnings(self._delays, self._setup)) or None if self._faults else None

    def _run(self) -> None:
        while not self._closing:
            self._wake.wait()
            self._wake.clear()
            while self._delays.due and not self._closing:
                self._solve()
            if self._delays.late and not self._faults:
                self._faults = Fault.CAMERA_LATE
                if self._warns:
                    text = "\n".join(warnings(self._delays, self._setup))
                    sys.stderr.write(f"\n{text}\n")


def warnings(delays: CameraDelays, setup: DriveSetup) -> Iterator[str]:
    """A line for each camera whose stamps are surely wrong, or one line for all cameras."""
    camera_delays, together = delays.delays, delays.common_delay
    file_s = Corrections.of(setup.vehicle).camera_delay_s
    known = [one for one in camera_delays if one.known]
    if together.late and len(known) != 1 and all(_agree(one, together) for one in known):
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


def _agree(one: Delay, together: Delay) -> bool:
    apart_s = abs(one.delay_s - together.delay_s)
    return apart_s < 3 * math.hypot(one.sigma_s, together.sigma_s)


def delays_of(log: DriveLog, setup: DriveSetup) -> CameraDelays:
    """The delays of the cameras in the recorded drive of a car."""
    delays = CameraDelays(setup.rig, setup.markers, setup.car(Path("the drive")))
    corrections, chassis = Corrections.of(setup.vehicle), chassis_of(setup.vehicle)
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
