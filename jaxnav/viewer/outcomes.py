"""Convert an outcome of the pilot, live or recorded, to the values that a viewer shows."""

from dataclasses import dataclass

import numpy as np

from jaxnav.belief.bicycle_kalman import planar_poses
from jaxnav.loop.flags import Fault, Health, Reject
from jaxnav.loop.pilot import Outcome
from jaxnav.models.origin import ZERO, Origin, inverses_in_world, opposite, planar_in_world
from jaxnav.recording.drive_log import Outcomes


@dataclass(frozen=True)
class ShownOutcome:
    """The values of an outcome that are shown; see `Outcomes`. Poses and candidates are NumPy
    arrays in coordinates from the map's origin."""

    now_ns: int
    health: Health
    faults: Fault
    rejects: Reject
    steering_rad: float
    throttle: float
    pose: np.ndarray
    covariance: np.ndarray
    located: bool
    flip_probability: float
    nis: float
    hypotheses: np.ndarray
    log_weight: np.ndarray
    Ts_vehicle_world: np.ndarray
    selected: int

    @staticmethod
    def of(outcome: Outcome) -> "ShownOutcome":
        """The shown values of the pilot's outcome."""
        output, bank = outcome.output, outcome.belief.bank
        alive, valid = np.asarray(bank.initialised), np.asarray(output.candidates.valid)
        selected = int(output.selected)
        return ShownOutcome(
            now_ns=outcome.now_ns,
            health=outcome.health,
            faults=outcome.faults,
            rejects=outcome.rejects,
            steering_rad=outcome.steering_rad,
            throttle=outcome.throttle,
            pose=np.asarray(output.pose),
            covariance=np.asarray(output.covariance),
            located=bool(output.located),
            flip_probability=float(output.flip_probability),
            nis=float(output.nis),
            hypotheses=np.asarray(planar_poses(bank)[0])[alive],
            log_weight=np.asarray(bank.log_weight)[alive],
            Ts_vehicle_world=np.asarray(output.candidates.T_vehicle_world.wxyz_xyz)[valid],
            selected=int(valid[:selected].sum()) if selected >= 0 else -1,
        )

    @staticmethod
    def of_row(outcomes: Outcomes, index: int, origin_m: Origin = ZERO) -> "ShownOutcome":
        """The shown values of one outcome of a recorded drive.

        Args:
            origin_m: origin of the map with which it is shown.
        """
        away_m = opposite(origin_m)
        return ShownOutcome(
            now_ns=int(outcomes.now_ns[index]),
            health=Health(int(outcomes.health[index])),
            faults=Fault(int(outcomes.faults[index])),
            rejects=Reject(int(outcomes.rejects[index])),
            steering_rad=float(outcomes.steering_rad[index]),
            throttle=float(outcomes.throttle[index]),
            pose=planar_in_world(outcomes.pose[index], away_m),
            covariance=outcomes.covariance[index],
            located=bool(outcomes.located[index]),
            flip_probability=float(outcomes.flip_probability[index]),
            nis=float(outcomes.nis[index]),
            hypotheses=planar_in_world(outcomes.hypotheses[index], away_m),
            log_weight=outcomes.log_weight[index],
            Ts_vehicle_world=inverses_in_world(outcomes.Ts_vehicle_world[index], away_m),
            selected=int(outcomes.selected[index]),
        )
