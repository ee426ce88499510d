"""Run the fault matrix: the faults that can occur on a drive, and the required results.

    for row in MATRIX:
        print(line(run_trial(row, trial)))

All faults act on corners, in lockstep drives of a simulated vehicle through a loop of waypoints.
Faults of images are tested with the search of frames, threads and signals with the loop.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import ZERO, Origin, planar_in_world, points_in_world
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.core.navigator import Navigator
from jaxnav.drive.camera_delays import CameraDelays
from jaxnav.drive.chassis import chassis_of
from jaxnav.drive.compiled_step import strip_static
from jaxnav.drive.estimator import Program
from jaxnav.drive.flags import Fault, Health, Reject, names
from jaxnav.drive.pilot import Outcome, Pilot
from jaxnav.files.markers import MarkerFile, marker_data
from jaxnav.files.vehicles import Route
from jaxnav.vehicles.conformance.injections import between
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, Change, Rates, Step, drive
from jaxnav.vehicles.world import SimWorld, WorldSettings

BEGIN_S, END_S = 2.5, 4.0  # of most faults
ALL_CAMERAS = range(4)  # of the trial's rig
SETTLE_S = 2.0  # this long after a fault the position must be right again
# A vehicle that is farther off than this and drives on at health OK counts as lying.
LIE_M = 0.5
WAYS = ("lied_m", "named_m", "slow_m", "stood_m")
WAYPOINTS_M = (
    (1.3, 0.0), (0.3, 0.2), (-0.8, -0.2), (-1.2, -1.0), (-0.3, -1.5), (0.8, -1.2), (1.5, -0.5),
    (0.5, 0.2), (-0.8, -0.2), (-1.2, -1.0), (-0.3, -1.5), (0.8, -1.2), (1.5, -0.5), (0.5, 0.2),
)  # fmt: skip
_RADIUS_M = 0.15

Happens = Callable[[int, SimWorld], None]


@dataclass(frozen=True)
class FaultRow:
    """One fault, and the requirements on a drive with it.

    Attributes:
        name: as `jaxnav faults` prints it.
        change: makes the change to the data on their way, anew for each drive.
        faults, rejects: one at least must be seen by SETTLE_S after its end; none: no requirement.
        health: bounds of the worst health in the same time.
        error_m: largest error of a decided position during the fault and SETTLE_S after.
        error_after_m: largest error after that.
        happens: makes the change to the world, anew for each drive.
        begins_s, ends_s: of the fault; inf: it lasts.
        always: the data are changed before `begins_s` too.
        drive_s: duration of the whole drive.
        rig_file, map_file: make what the files say of the rig and of the map from the true ones.
        markers: makes the drive's markers from the trial's.
        relocate: see `Pilot`.
        well: the worst health at which the car has recovered.
        shift_m: offset of the files' coordinates of map and route from the trial's world.
        bases: the vehicles on which it is tried, see `Trial.base`.
        gyro: tried only on vehicles that have one.
        lied_m, named_m, slow_m, stood_m: the most that the ways of the drive may be, see `Result`.
    """

    name: str
    change: Callable[[], Change] = lambda: lambda given: [given]
    faults: Fault = Fault(0)  # noqa: RUF009
    rejects: Reject = Reject(0)  # noqa: RUF009
    health: tuple[Health, Health] = (Health.OK, Health.OK)
    error_m: float = 0.05
    error_after_m: float = 0.05
    happens: Callable[[], Happens] = lambda: lambda now_ns, world: None
    begins_s: float = BEGIN_S
    ends_s: float = END_S
    always: bool = False
    drive_s: float = 7.0
    rates: Rates = field(default_factory=Rates)
    rig_file: Callable[[CameraRig], CameraRig] = lambda rig: rig
    map_file: Callable[[MarkerMap], MarkerMap] = lambda markers: markers
    markers: Callable[[MarkerMap], MarkerMap] = lambda markers: markers
    relocate: bool = True
    well: Health = Health.OK
    shift_m: Origin = ZERO
    bases: tuple[str, ...] = ("ackermann",)
    gyro: bool = False
    lied_m: float = math.inf
    named_m: float = math.inf
    slow_m: float = math.inf
    stood_m: float = math.inf

    def suits(self, trial: "Trial") -> bool:
        """Whether the row is tried on the trial's vehicle."""
        has_gyro = trial.vehicle.gyro is not None
        return trial.base in self.bases and (has_gyro or not self.gyro)


@dataclass(frozen=True)
class Result:
    """The result of a drive with a fault.

    Attributes:
        faults, rejects, worst, error_m, error_after_m: see `FaultRow`.
        recovered_s: from the fault's end to lasting health; inf: never, or the fault lasts.
        ways_m: how far the vehicle has truly driven, m, with the way of its rim where it turns:
            `lied_m` at health OK while its pose is more than LIE_M off; `named_m`, `slow_m`,
            `stood_m` from the fault's begin until one of the row's faults is reported, until
            health is DEGRADED or worse, and until it stands in the end; inf: never.
        broken: promises that were not kept.
    """

    row: FaultRow
    faults: Fault
    rejects: Reject
    worst: Health
    error_m: float
    error_after_m: float
    recovered_s: float
    restarts: int
    ways_m: dict[str, float]
    broken: tuple[str, ...] = ()


@dataclass(frozen=True)
class Trial:
    """The vehicle and world in which the faults are tried."""

    rig: CameraRig
    markers: MarkerMap
    vehicle: Vehicle | TwistBase
    start_pose: tuple[float, float, float] = (2.0, -1.0, math.radians(125.0))
    waypoints_m: tuple[tuple[float, float], ...] = WAYPOINTS_M
    seed: int = 0
    settings: WorldSettings | None = None
    program: Callable[[Navigator], Program] | None = None  # see `Pilot`; by default by `jax.jit`

    @property
    def base(self) -> str:
        """The kind of the vehicle, one of `BASES` of the simulation."""
        if not isinstance(self.vehicle, TwistBase):
            return "ackermann"
        return "omni" if self.vehicle.left_limit_mps > 0 else "differential"


def run_trial(row: FaultRow, trial: Trial) -> Result:
    """Drive with a row's fault, and judge the drive."""
    trial = dataclasses.replace(trial, markers=row.markers(trial.markers))
    markers, route = shift_origin(trial, row.shift_m)
    navigator = Navigator(
        rig=row.rig_file(trial.rig),
        markers=row.map_file(markers),
        vehicle=trial.vehicle,
        waypoints_m=route.waypoints_m,
        waypoint_radius_m=route.waypoint_radius_m,
    )
    program = trial.program and trial.program(strip_static(navigator))
    leave_m = route.leaves_at_m
    pilot = Pilot(navigator, program=program, relocate=row.relocate, leave_m=leave_m)
    world = SimWorld(
        trial.rig, markers, trial.vehicle, route.start_pose, BEGIN_NS, trial.settings, trial.seed
    )
    delays = None
    if Fault.CAMERA_LATE in row.faults and isinstance(trial.vehicle, Vehicle):
        delays = CameraDelays(navigator.rig, markers, trial.vehicle)
    change = between(-math.inf if row.always else row.begins_s, row.ends_s, row.change())
    steps = list(drive(pilot, world, row.drive_s, change, row.rates, row.happens(), delays))
    return judge(row, steps, pilot)


def shift_origin(trial: Trial, shift_m: Origin) -> tuple[MarkerMap, Route]:
    """The map and route of a drive whose files have a shifted origin.

    The trial's own coordinates count from the origin of its map.
    """
    if shift_m == ZERO:
        return trial.markers, Route(trial.waypoints_m, _RADIUS_M, trial.start_pose)
    x_m, y_m, z_m = np.add(trial.markers.origin_m, shift_m).tolist()
    data = marker_data(dataclasses.replace(trial.markers, origin_m=(x_m, y_m, z_m)))
    markers = MarkerFile.model_validate(data).map()
    waypoints_m = points_in_world(trial.waypoints_m, (x_m, y_m, z_m))
    start_pose = planar_in_world(trial.start_pose, (x_m, y_m, z_m))
    return markers, Route(waypoints_m, _RADIUS_M, start_pose).relative_to(markers.origin_m)


def judge(row: FaultRow, steps: list[Step], pilot: Pilot) -> Result:
    """Compare a drive with the requirements of its row."""
    times_s = np.array([(step.input.now_ns - BEGIN_NS) / 1e9 for step in steps])
    outcomes = [step.outcome for step in steps]
    healths = np.array([outcome.health for outcome in outcomes])
    errors_m = np.array([_error_m(step) for step in steps])
    shaken = (times_s >= row.begins_s) & (times_s < row.ends_s + SETTLE_S)
    faults, rejects = Fault(0), Reject(0)
    for index in np.flatnonzero(shaken):
        faults |= outcomes[index].faults
        rejects |= outcomes[index].rejects
    after = np.flatnonzero(times_s >= row.ends_s)
    ill = after[(healths[after] < Health.OK) | (healths[after] > row.well)]
    well = after[after > ill.max(initial=-1)]  # all that follow the last ill one
    controller = pilot.navigator.controller
    assert controller is not None  # a pilot has one
    result = Result(
        row,
        faults,
        rejects,
        worst=Health(int(healths[shaken].max(initial=0))),
        error_m=float(np.nanmax(errors_m[shaken], initial=0.0)),
        error_after_m=float(np.nanmax(errors_m[times_s >= row.ends_s + SETTLE_S], initial=0.0)),
        recovered_s=float(times_s[well[0]] - row.ends_s) if len(well) else math.inf,
        restarts=outcomes[-1].restarts,
        ways_m=_ways_m(row, steps, chassis_of(controller.vehicle).lever_m),
    )
    return dataclasses.replace(result, broken=tuple(_broken(result, steps, pilot)))


def _ways_m(row: FaultRow, steps: list[Step], lever_m: float) -> dict[str, float]:
    """How far a drive went on a lie; see `Result`.

    Args:
        lever_m: way of the rim by a turn of 1 rad, see `Chassis`.
    """
    ways_m = dict.fromkeys(WAYS, math.inf) | {"lied_m": 0.0}
    way_m = 0.0
    for before, step in pairwise(steps):
        moved = step.truth[:3] - before.truth[:3]
        gone_m = float(np.hypot(*moved[:2])) + lever_m * abs(float(moved[2]))
        outcome = before.outcome
        off_m = np.hypot(*(outcome.pose - planar_in_world(before.truth[:3], outcome.origin_m))[:2])
        if outcome.health == Health.OK and off_m > LIE_M:
            ways_m["lied_m"] += gone_m
        if (step.input.now_ns - BEGIN_NS) / 1e9 < row.begins_s:
            continue
        way_m += gone_m
        if step.outcome.faults & row.faults:
            ways_m["named_m"] = min(ways_m["named_m"], way_m)
        if step.outcome.health >= Health.DEGRADED:
            ways_m["slow_m"] = min(ways_m["slow_m"], way_m)
    if _stands(steps[-1].outcome):
        ways_m["stood_m"] = way_m
    return ways_m


def _stands(outcome: Outcome) -> bool:
    """Whether the command is to stand."""
    return outcome.throttle == 0 and not any(outcome.twist or ())


def _error_m(step: Step) -> float:
    """The error, m, of a decided position while the car drives; NaN otherwise."""
    outcome = step.outcome
    if not outcome.output.decided or _stands(outcome):
        return math.nan
    truth = planar_in_world(step.truth[:3], outcome.origin_m)
    return float(np.hypot(*(outcome.pose[:2] - truth[:2])))


def _broken(result: Result, steps: list[Step], pilot: Pilot) -> list[str]:
    row, broken = result.row, []
    if row.faults and not result.faults & row.faults:
        broken.append(f"no {'/'.join(names(row.faults))}")
    if row.rejects and not result.rejects & row.rejects:
        broken.append(f"no {'/'.join(names(row.rejects))}")
    if not row.health[0] <= result.worst <= row.health[1]:
        broken.append(f"health {result.worst.name}")
    if result.error_m > row.error_m:
        broken.append(f"error {result.error_m:.3f} m")
    if result.error_after_m > row.error_after_m:
        broken.append(f"error afterwards {result.error_after_m:.3f} m")
    if math.isfinite(row.ends_s) and result.recovered_s > SETTLE_S:
        broken.append(f"recovered after {result.recovered_s:.1f} s")
    for name, way_m in result.ways_m.items():
        if way_m > getattr(row, name):
            broken.append(f"{name} {way_m:.2f}")
    limits = pilot.limits
    for step in steps:
        command = step.outcome.command
        if limits.within(command, command, 0.0) != command:
            broken.append(f"command {', '.join(map(str, command))}")
            break
        stands = limits.standing(command) == command
        if step.outcome.health in (Health.STOP, Health.INIT) and not stands:
            broken.append("drives in STOP")
            break
    return broken


HEADER = (
    "| fault | seen | worst health | error m | afterwards | recovered s | restarts | "
    "m at OK and off | m until named | slow | standing | kept |\n"
    f"|{12 * '---|'}"
)


def line(result: Result) -> str:
    """A result as a row of the table."""
    seen = ", ".join([*names(result.faults), *names(result.rejects)]).lower() or "-"
    recovered = "-" if math.isinf(result.recovered_s) else f"{result.recovered_s:.2f}"
    kept = "; ".join(result.broken) or "yes"
    ways = ["-" if math.isinf(way_m) else f"{way_m:.2f}" for way_m in result.ways_m.values()]
    return (
        f"| {result.row.name} | {seen} | {result.worst.name} | {result.error_m:.3f} | "
        f"{result.error_after_m:.3f} | {recovered} | {result.restarts} | {' | '.join(ways)} | "
        f"{kept} |"
    )
