"""Turn events into commands: the deterministic half of the loop, with no clock, thread or file.

    pilot = Pilot(navigator)
    outcome = pilot.handle(Input(now_ns, odometry=reading))
    outcome = pilot.handle(Input(now_ns, frames=sighted))

The same events give the same outcomes, so a recorded drive can be replayed bit for bit. Every event
is one call of one compiled program.
"""

import math
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxnav.core.filter.estimate import Belief
from jaxnav.core.filter.planar import planar_poses
from jaxnav.core.models.origin import ZERO, Origin, planar_in_world, poses_in_world
from jaxnav.core.navigator import Navigator, Output
from jaxnav.core.pose.refine import Candidates
from jaxnav.drive.actuation import Actuation
from jaxnav.drive.chassis import chassis_of, pace_mps, root_of_sum
from jaxnav.drive.compiled_step import strip_static
from jaxnav.drive.corrections import Corrections
from jaxnav.drive.estimator import Estimator, Program, gyro_of
from jaxnav.drive.expect import Place, due_px, quads_px
from jaxnav.drive.flags import Fault, Health, Reject
from jaxnav.drive.frames import FrameDetections, FrameIntake
from jaxnav.drive.gyro import TurnVotes
from jaxnav.drive.health import RESTARTS_S, SPEED_FACTOR, Monitor, Senses, Timeouts
from jaxnav.drive.history import EventData, Sighting
from jaxnav.drive.interfaces import GyroReading, Reading
from jaxnav.drive.limits import Command
from jaxnav.drive.odometer import Odometers
from jaxnav.drive.outvoted import CameraVotes, MarkerVotes, Twins
from jaxnav.drive.stamps import Stamps
from jaxnav.drive.standstill import Standstill, Way, between
from jaxnav.drive.support import Support
from jaxnav.drive.ways import Corridor, Fix
from jaxnav.files.poses import rotated

SLEPT_NS = 1_000_000_000  # after a pause this long in the loop, its belief is out of date
GYRO_STALE_S = 0.1  # as the odometer
_SEEING_NS = 500_000_000  # this long after a fix, the estimate's speed is as good as the odometer's
_NO_FAULT, _NO_REJECT = Fault(0), Reject(0)


@dataclass(frozen=True)
class Input:
    """The data that reach the pilot at one instant: odometry, frames, both, or neither (a tick).

    Attributes:
        gyro: readings since the input before, the oldest first.
        frames: from different cameras. Frames that show markers were captured together.
        faults: found by the caller.
    """

    now_ns: int
    odometry: Reading | None = None
    frames: tuple[FrameDetections, ...] = ()
    faults: Fault = _NO_FAULT
    gyro: tuple[GyroReading, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """The pilot's result for one event. Coordinates of output and belief count from `origin_m`.

    Attributes:
        steering_rad, throttle: the command of a car, within the limits; 0 of another base.
        twist: that of another base: forward_mps, left_mps, turn_radps; None of a car.
    """

    now_ns: int
    health: Health
    faults: Fault
    rejects: Reject
    steering_rad: float
    throttle: float
    output: Output  # its leaves, and those of `belief`, are NumPy arrays
    belief: Belief
    data: EventData | None  # the data that were fused, and their timestamp
    stamp_ns: int
    restarts: int  # so far, and the reason of the last one
    restart_reason: str
    outvoted: tuple[int, ...] = ()  # ids of markers left out because others contradict them
    outvoted_cameras: tuple[str, ...] = ()  # names of those that are left out
    origin_m: Origin = ZERO  # see `MarkerMap`
    twist: Command | None = None

    @property
    def command(self) -> Command:
        """The command, as the vehicle's `write` takes it."""
        return (self.steering_rad, self.throttle) if self.twist is None else self.twist

    @property
    def pose(self) -> Float[np.ndarray, " 3"]:
        """The pose in the world: (3,) x_m, y_m, psi_rad."""
        return np.asarray(planar_in_world(self.output.pose, self.origin_m))

    @property
    def T_world_vehicle(self) -> Float[np.ndarray, " 7"]:
        """The pose of the vehicle in the world: (7,) wxyz_xyz."""
        return np.asarray(poses_in_world(self.output.T_world_vehicle.wxyz_xyz, self.origin_m))


class _Known(NamedTuple):
    """The fields of an output that the pilot uses."""

    pose: np.ndarray  # x_m, y_m, psi_rad
    pose_covariance: np.ndarray
    velocity: np.ndarray  # derivative of the pose
    velocity_covariance: np.ndarray
    located: bool
    decided: bool
    accepted: bool
    nis: float
    gate_nis: float
    command: Command

    @staticmethod
    def from_output(output: Output) -> "_Known":
        of_output = vars(output)  # reading an attribute of an equinox module takes 1 us
        command = vars(of_output["command"])
        return _Known(
            of_output["pose"],
            of_output["pose_covariance"],
            of_output["velocity"],
            of_output["velocity_covariance"],
            bool(of_output["located"]),
            bool(of_output["decided"]),
            bool(of_output["accepted"]),
            float(of_output["nis"]),
            float(of_output["gate_nis"]),
            tuple(map(float, command.values())),
        )

    @property
    def is_finite(self) -> bool:
        arrays = self.pose, self.pose_covariance, self.velocity, self.velocity_covariance
        return all(math.isfinite(number) for array in arrays for number in array.ravel().tolist())

    @property
    def position_sigma_m(self) -> float:
        return root_of_sum(self.pose_covariance)


class Pilot:
    """The pilot of one drive. Not thread-safe."""

    def __init__(
        self,
        navigator: Navigator,
        timeouts: Timeouts | None = None,
        program: Program | None = None,
        corner_sigma_px: float | None = None,
        relocate: bool = True,
        drives: bool = True,
        leave_m: float = math.inf,
    ):
        """Args:
        navigator: with a vehicle and waypoints.
        timeouts: see `Timeouts`.
        program: compiled `advance_packed` of the navigator; by default compiled by `jax.jit`.
        corner_sigma_px: of every corner along one axis; by default as each detection says.
        relocate: whether to drive on from a pose that no slip explains, slowly at first; else stop.
        drives: whether the commands are the pilot's; else somebody else drives, they are zero, and
            no throttle is known to hold the odometer against.
        leave_m: how far from its route it may drive, see `Corridor`.
        """
        if navigator.controller is None:
            raise ValueError("a pilot's navigator needs a vehicle and waypoints")
        self.navigator = navigator
        self._unnamed = strip_static(navigator)  # as compiled programs have it
        self._origin_m = navigator.markers.origin_m
        self._chassis = chassis_of(navigator.controller.vehicle)
        self.limits = self._chassis.limits
        self._corrections = Corrections.from_vehicle(navigator.controller.vehicle)
        gyro = gyro_of(navigator)
        self._turns = None if gyro is None else TurnVotes(self._chassis, gyro)
        mean_radps = None if self._turns is None else self._turns.mean_radps
        self._estimator = Estimator(navigator, program, mean_radps)
        self._frames = FrameIntake(len(navigator.rig), navigator.markers, corner_sigma_px)
        self._monitor = Monitor(timeouts or Timeouts())
        self._drives = drives
        self._odometry_stamps = Stamps()
        self._odometers = Odometers(self._chassis)
        self._standstill = Standstill(Way(self._chassis.lever_m), self._chassis.time_constant_s)
        self._frozen = partial(self._standstill.is_frozen, due=self._due_px)
        self._support = Support(self._chassis, relocate)
        self._actuation = Actuation(self._chassis)
        self._corridor = Corridor(np.asarray(navigator.controller.waypoints_m), leave_m)
        self._marker_votes = MarkerVotes(navigator.markers.ids)
        self._camera_votes = CameraVotes(navigator)
        self._twins = Twins(navigator)
        centres_m = np.asarray(navigator.markers.Ts_world_marker.translation(), float)
        self._centres_m = centres_m.tolist()
        self._lane, self._look_ns = (0, 0), 0  # camera and marker whose range is watched, and when
        self._on_twins = False  # whether the estimate may be by an id at two places
        self._sure = False  # whether the estimate may judge cameras
        self._odometer_ns: int | None = None
        self._fix_ns: int | None = None
        self._distance_m = 0.0
        self._now_ns: int | None = None
        self._began_ns: int | None = None
        self._known: _Known | None = None
        self._restarts = self._restarts_before = 0
        self._restart_reason = ""
        self._restarts_ns: deque[int] = deque()  # times of the recent restarts
        self._left: _Known | None = None  # the estimate before a restart
        self._command = self.limits.zero
        self._commanded_ns: int | None = None

    def warm_up(self) -> None:
        """Compile the programs without changing the pilot's state."""
        self._estimator.warm_up()
        due_px(self._unnamed, np.zeros(3), (0.0, 0.0, 0.0))
        self._twins.warm_up()

    def handle(self, given: Input) -> Outcome:
        """Fuse an input, frames first. `now_ns` must not be less than in the input before."""
        now_ns, faults = given.now_ns, given.faults | self._slept(given.now_ns)
        if self._turns is not None:
            faults |= self._turns.track.take(given.gyro, now_ns)
        frames = [self._corrections.correct_frame(frame) for frame in given.frames]
        data, stamp_ns, seen_faults = self._frames.check(frames, now_ns, self._frozen)
        faults |= seen_faults
        if data is not None:
            data = self._without_outvoted(data, stamp_ns)
        if self._twins.seen(now_ns):
            faults |= Fault.DUPLICATE_MARKER
        if data is not None:
            outcome = self._fuse(data, stamp_ns, now_ns, faults)
        if given.odometry is not None:
            return self._odometry(self._corrections.correct_reading(given.odometry), now_ns, faults)
        return outcome if data is not None else self._tick(now_ns, faults)

    def _odometry(self, reading: Reading, now_ns: int, faults: Fault) -> Outcome:
        known, jumps, chassis = self._known, self._odometry_stamps.jumps, self._chassis
        wanted_mps = chassis.wanted_mps(self._command) if self._drives else None
        stamp_ns = self._odometry_stamps.take(reading.stamp_ns, now_ns)
        if not (reading.valid and chassis.reads(reading)):
            return self._tick(now_ns, faults | Fault.ODOMETRY_INVALID)
        if stamp_ns is None:
            return self._tick(now_ns, faults | Fault.STAMP_INVALID)
        if self._odometry_stamps.jumps > jumps:
            faults |= Fault.CLOCK_JUMPED
        driven_mps, motion = chassis.driven_mps(reading), chassis.motion(reading)
        if self._turns is not None:
            self._turns.add_reading(now_ns, motion)
        pace = pace_mps(driven_mps)
        believable, faults_seen = self._odometers.judge(
            driven_mps,
            reading.values,
            stamp_ns,
            self._believed_mps(),
            self._seeing(now_ns),
            wanted_mps,
            self._standstill.add_reading(stamp_ns, now_ns, pace),
        )
        faults |= faults_seen
        if Fault.ODOMETRY_STUCK in faults_seen:
            self._estimator.forget_speed()
        if not believable:
            return self._tick(now_ns, faults, Reject.ODOMETRY)
        if self._odometer_ns is not None:
            gap_s = min(max(stamp_ns - self._odometer_ns, 0), SLEPT_NS) / 1e9
            self._distance_m += pace * gap_s
            heading_rad = 0.0 if known is None else float(known.pose[2])
            self._support.add_odometry(
                driven_mps, motion, heading_rad, gap_s, wanted_mps, self._seeing(now_ns)
            )
        self._odometer_ns = max(stamp_ns, self._odometer_ns or 0)
        self._standstill.add_believed(stamp_ns, now_ns, pace, motion)
        data = EventData(odometry=reading.values)
        return self._fuse(data, stamp_ns, now_ns, faults)

    def _tick(self, now_ns: int, faults: Fault, rejects: Reject = _NO_REJECT) -> Outcome:
        return self._fuse(None, now_ns, now_ns, faults, rejects)

    def _fuse(
        self,
        data: EventData | None,
        stamp_ns: int,
        now_ns: int,
        faults: Fault,
        rejects: Reject = _NO_REJECT,
    ) -> Outcome:
        elapsed_ns = 0 if self._commanded_ns is None else now_ns - self._commanded_ns
        fused = self._estimator.fuse(data, stamp_ns, now_ns, elapsed_ns)
        known = _Known.from_output(fused.output)
        finite = known.is_finite
        if not finite:
            faults |= Fault.NOT_FINITE
            self._begin_anew("the estimate was no number")
        if fused.refused:
            rejects |= Reject.TOO_LATE
        seen = data if isinstance(data, Sighting) else None
        if seen is not None and fused.refused:
            self._frames.forget_last()
        restarts = self._restarts_before + int(fused.belief.restarts)
        if finite and restarts > self._restarts:
            self._restarts, self._restart_reason = restarts, "contradicted by the corners"
            faults |= Fault.RESTARTED
            self._left = self._known
            self._restarts_ns.append(now_ns)
            self._support.note_restart()
            self._actuation.forget_place()
            if self._turns is not None:
                self._turns.forget()
        if seen is not None and not fused.refused:
            self._marker_votes.count(seen, np.asarray(fused.output.outvoted))
            candidates = vars(fused.output)["candidates"]
            self._add_place(seen, stamp_ns, candidates)
            rejects |= self._judge(known, fused.belief, candidates, stamp_ns, now_ns)
        doubts = self._support.faults
        if self._drives:
            doubts |= self._actuation.faults
        faults |= doubts
        if self._turns is not None:
            faults |= Fault.GYRO_CONTRADICTED if self._turns.gyro_is_wrong else _NO_FAULT
            stale = self._age_s(self._turns.track.newest_ns, now_ns) > GYRO_STALE_S
            faults |= Fault.GYRO_STALE if stale else _NO_FAULT
        markers, cameras = self._marker_votes.outvoted, self._camera_votes.outvoted
        faults |= Fault.MARKER_OUTVOTED if markers else _NO_FAULT
        faults |= Fault.CAMERA_OUTVOTED if cameras else _NO_FAULT
        # A fix since then is by other ids.
        self._on_twins = self._twins.seen(now_ns) and (self._fix_ns or 0) < self._twins.last_ns
        placed = known.decided and self._support.confirmed and not self._on_twins
        self._sure = placed and not doubts
        # Who was carried off is where it finds itself.
        if self._drives and placed and not doubts & ~Fault.RELOCATED:
            faults |= Fault.LEFT_ROUTE if self._corridor.is_left(known.pose[:2]) else _NO_FAULT
        output, known = self._honest(fused.output, known)
        if self._left is not None and output.decided:
            self._restart_reason += f"; {_apart(self._left.pose, known.pose)} away"
            self._left = None
        self._known, self._now_ns = known, now_ns
        if self._standstill.nothing_moves:
            faults |= Fault.NOTHING_MOVES
        health, faults = self._monitor.look(self._senses(known, now_ns, faults))
        factor = 0.0 if Fault.HELD in faults else SPEED_FACTOR[health]
        command = self._limited(known, factor, now_ns, elapsed_ns)
        steering_rad, throttle = command if len(command) == 2 else (0.0, 0.0)
        return Outcome(
            now_ns,
            health,
            faults,
            rejects,
            steering_rad,
            throttle,
            output,
            fused.belief,
            data,
            stamp_ns,
            self._restarts,
            self._restart_reason,
            markers,
            cameras,
            self._origin_m,
            None if len(command) == 2 else command,
        )

    def _believed_mps(self) -> tuple[tuple[float, float], ...] | None:
        """The speeds of the driven parts by a decided estimate; None without one."""
        known = self._known
        if known is None or not known.decided:
            return None
        moves = known.velocity, known.velocity_covariance
        return self._chassis.believed_mps(float(known.pose[2]), *moves)

    def _judge(
        self, known: _Known, belief: Belief, candidates: Candidates, stamp_ns: int, now_ns: int
    ) -> Reject:
        """Use the corners to confirm or doubt the estimate; return their `Reject` flags."""
        agrees = known.accepted and known.nis <= known.gate_nis
        if not agrees:
            self._camera_votes.note_contradiction(stamp_ns)
        self._monitor.corners(agrees)
        fix = _fix(known.pose, known.pose_covariance) if known.decided else None
        if fix is None or not agrees:
            self._actuation.add_headings(now_ns, _headings(candidates))
        elif self._support.confirmed:
            self._actuation.add_fix(now_ns, fix)
            if self._turns is not None:
                self._turns.add_fix(now_ns, fix.psi_rad)
        bank = belief.bank
        alive = zip(*planar_poses(bank), bank.initialised, strict=True)
        support = self._support
        before = support.relocations, support.refused

        def possible() -> list[Fix]:
            return [_fix(pose, covariance) for pose, covariance, lives in alive if lives]

        if support.add_corners(known.accepted, agrees, now_ns, fix, possible):
            self._fix_ns, self._distance_m = max(stamp_ns, self._fix_ns or 0), 0.0
        if support.relocations > before[0] or support.refused > before[1]:
            what = "refused" if support.refused else "relocated"
            parts = [self._restart_reason, f"{what}: no slip explains the way there"]
            self._restart_reason = "; ".join(part for part in parts if part)
        if not known.accepted:
            return Reject.INNOVATION
        return Reject.INNOVATION_LARGE if known.nis > known.gate_nis / 2 else _NO_REJECT

    def _add_place(self, data: Sighting, stamp_ns: int, candidates: Candidates) -> None:
        """Watch how the range of a marker in view changes; see `Ranges`."""
        valid = np.asarray(candidates.valid)
        best = int(np.argmin(np.where(valid, candidates.cost, np.inf)))
        then_ns, way = self._look_ns, self._standstill.way
        if not valid[best] or stamp_ns <= then_ns:
            return
        lanes = [(camera, marker) for camera, marker in np.argwhere(data.visible).tolist()]
        if self._lane not in lanes:
            self._lane = lanes[0]
        if lanes[0][0] != lanes[-1][0]:
            # Of several cameras the pose is theirs together: their places tell its range.
            place_m = self._twins.place_m(*self._lane)
        else:
            T_vehicle_world = np.asarray(candidates.T_vehicle_world.wxyz_xyz)[best].tolist()
            turned = rotated(T_vehicle_world[:4], self._centres_m[self._lane[1]])
            place_m = [a + b for a, b in zip(turned, T_vehicle_world[4:], strict=True)]
        then, now = way.at(then_ns), way.at(stamp_ns)
        motion = None if then is None or now is None else between(then, now)
        if self._support.ranges.add_place(self._lane, place_m, motion):
            self._look_ns = stamp_ns

    def _without_outvoted(self, data: Sighting, stamp_ns: int) -> Sighting | None:
        """What is left of a frame without views that others contradict; None: nothing."""
        known, votes = self._known, self._camera_votes
        if self._sure and known is not None and votes.open(stamp_ns):
            votes.count(data, quads_px(self._unnamed, known.pose), stamp_ns)
        left = votes.remove_outvoted(data)
        if left is not None:
            # By an estimate that has agreed with a way a knocked camera is told from a copy.
            judged = self._sure and self._support.ranges.agreed
            left = self._twins.remove_twins(left, stamp_ns, self._standstill.way, judged)
        return None if left is None else self._marker_votes.remove_outvoted(left)

    def _honest(self, output: Output, known: _Known) -> tuple[Output, _Known]:
        """The estimate to report: an unconfirmed one is not decided, its covariance is widened."""
        disobeyed = self._drives and bool(self._actuation.faults)
        contradicted = self._monitor.contradicted or disobeyed or self._on_twins
        doubt_m = self._support.doubt_m(contradicted)
        if doubt_m is None or not known.decided:
            return output, known
        covariances = [np.array(output.pose_covariance), np.array(output.covariance)]
        for covariance in covariances:
            covariance[[0, 1], [0, 1]] += doubt_m**2 / 2
        honest: Output = eqx.tree_at(
            lambda output: (output.decided, output.pose_covariance, output.covariance),
            output,
            (np.asarray(False), *covariances),
        )
        return honest, known._replace(pose_covariance=covariances[0])

    def _limited(self, known: _Known, factor: float, now_ns: int, elapsed_ns: int) -> Command:
        for judge in (self._actuation, self._turns):
            if judge is not None:
                judge.add_command(self._command, min(elapsed_ns, SLEPT_NS) / 1e9)
        if self._drives:
            wanted = self.limits.slowed(known.command, factor)
            self._command = self.limits.within(wanted, self._command, elapsed_ns / 1e9)
        self._commanded_ns = now_ns
        self._standstill.add_command(self._chassis.wanted_mps(self._command), now_ns)
        return self._command

    def _senses(self, known: _Known, now_ns: int, faults: Fault) -> Senses:
        while self._restarts_ns and now_ns - self._restarts_ns[0] > RESTARTS_S * 1e9:
            self._restarts_ns.popleft()
        age_s = partial(self._age_s, now_ns=now_ns)
        return Senses(
            located=known.located,
            decided=known.decided,
            fix_age_s=age_s(self._fix_ns),
            odometry_age_s=age_s(self._odometer_ns),
            cameras_age_s=tuple(age_s(stamp_ns) for stamp_ns in self._frames.newest_ns),
            position_sigma_m=known.position_sigma_m,
            distance_m=self._distance_m,
            faults=faults,
            restarts=len(self._restarts_ns),
            confirmed=self._support.confirmed,
            refused=self._support.stands or (self._drives and self._actuation.gives_up),
        )

    def _age_s(self, stamp_ns: int | None, now_ns: int) -> float:
        """The age of a stamp, s; of none that since the drive began."""
        if stamp_ns is None:
            stamp_ns = now_ns if self._began_ns is None else self._began_ns
        return max(now_ns - stamp_ns, 0) / 1e9

    def _due_px(self, motion: Place) -> tuple[np.ndarray, np.ndarray] | None:
        """See `due_px`; None where the pose is not known."""
        known = self._known
        return due_px(self._unnamed, known.pose, motion) if known and known.located else None

    def _slept(self, now_ns: int) -> Fault:
        """Start anew if the loop paused for so long that its belief is out of date."""
        self._began_ns = now_ns if self._began_ns is None else self._began_ns
        if self._now_ns is None or abs(now_ns - self._now_ns) <= SLEPT_NS:
            return _NO_FAULT
        self._begin_anew("the loop was away for over a second")
        self._now_ns = None
        return Fault.CLOCK_JUMPED | Fault.RESTARTED

    def _begin_anew(self, reason: str) -> None:
        self._estimator.reset()
        self._support.begin_anew()
        self._actuation.forget()
        if self._turns is not None:
            self._turns.forget()
        self._restarts += 1
        if self._now_ns is not None:
            self._restarts_ns.append(self._now_ns)
        self._restarts_before, self._restart_reason = self._restarts, reason
        self._fix_ns, self._distance_m = None, 0.0
        self._left = self._known

    def _seeing(self, now_ns: int) -> bool:
        """Whether recent corners tell how fast the vehicle is."""
        return self._fix_ns is not None and now_ns - self._fix_ns < _SEEING_NS


def _fix(pose: np.ndarray, covariance: np.ndarray) -> Fix:
    """The fix of a pose (x_m, y_m, psi_rad) and its covariance."""
    x_m, y_m, psi_rad = map(float, pose[:3])
    sigma_rad = math.sqrt(max(float(covariance[2, 2]), 0.0))
    return Fix(x_m, y_m, psi_rad, root_of_sum(covariance), sigma_rad)


def _headings(candidates: Candidates) -> list[tuple[float, float]]:
    """Where the vehicle heads by each pose that the corners may mean: psi_rad, sigma_rad."""
    of = vars(candidates)
    quaternions, covariances = of["T_vehicle_world"].wxyz_xyz[:, :4], of["covariance"]
    headings = []
    for index in np.flatnonzero(of["valid"]).tolist():
        w, x, y, z = quaternions[index].tolist()
        psi_rad = math.atan2(2 * (x * y - w * z), 1 - 2 * (y * y + z * z))
        headings.append((psi_rad, math.sqrt(max(float(covariances[index, 5, 5]), 0.0))))
    return headings


def _apart(pose: np.ndarray, other: np.ndarray) -> str:
    """The distance and turn from a pose to another, as text."""
    x_m, y_m, psi_rad = other - pose
    psi_deg = math.degrees(math.remainder(float(psi_rad), math.tau))
    return f"{math.hypot(x_m, y_m):.2f} m and {psi_deg:.0f} deg"
