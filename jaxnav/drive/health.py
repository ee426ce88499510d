"""Decide the health of the vehicle, and with it how fast the vehicle may go.

See docs/promises.md, It knows what it does not know.
"""

from dataclasses import dataclass, field

from jaxnav.drive.flags import Fault, Health

# A better state needs this many good looks in a row. Corners count up with every contradiction and
# down with every agreement, and are bad at ten (ArduPilot's EKF check).
LOOKS = 10
_OFTEN = 10
# A vehicle that is carried off restarts once, or twice where it takes the mirror pose first. One
# that restarts more often within RESTARTS_S has no stable belief, and stands until those restarts
# are older. That does not trip the watchdog: the drive goes on by itself.
MOST_RESTARTS, RESTARTS_S = 3, 10.0

SPEED_FACTOR = {
    Health.INIT: 0.0,
    Health.ALIGNED: 1.0,
    Health.OK: 1.0,
    Health.DEAD_RECKONING: 1.0,
    Health.DEGRADED: 0.5,
    Health.STOP: 0.0,
}


_NO_FAULT = Fault(0)
_BROKEN = Fault.NOT_FINITE | Fault.VEHICLE_FAILED | Fault.NOTHING_MOVES | Fault.RESTARTED_OFTEN
_LOST = Fault.UNSURE | Fault.FAR_FROM_FIX | Fault.LEFT_ROUTE
_SLOW = (
    Fault.CAMERAS_STALE
    | Fault.ODOMETRY_STALE
    | Fault.ODOMETRY_STUCK
    | Fault.RELOCATED
    | Fault.WAYS_DISPUTED
    | Fault.ODOMETRY_DOUBTFUL
    | Fault.DRIVE_CONTRADICTED
    | Fault.SIDEWAYS_CONTRADICTED
    | Fault.TURN_CONTRADICTED
    | Fault.FILES_CONTRADICTED
)


@dataclass(frozen=True)
class Timeouts:
    """The limits beyond which missing data lower the health."""

    camera_stale_s: float = 0.2  # PX4
    odometry_stale_s: float = 0.1  # PX4
    flag_s: float = 1.0  # without a marker: dead reckoning
    slow_s: float = 2.0
    stop_s: float = 5.0  # PX4
    blind_s: float = 1.0  # without a marker and without odometry: nothing tells where it goes
    position_sigma_m: float = 0.5
    distance_m: float = 3.0  # driven without a marker


@dataclass(frozen=True)
class Senses:
    """The state of the data at one instant. Ages in s, inf: never."""

    located: bool
    decided: bool
    fix_age_s: float  # time since the last fix
    odometry_age_s: float
    cameras_age_s: tuple[float, ...]
    position_sigma_m: float
    distance_m: float  # driven since the last fix
    faults: Fault  # found elsewhere
    restarts: int = 0  # in the last RESTARTS_S
    confirmed: bool = True  # by corners, more than once (see `support`)
    # The pose is not to be driven on (see `Support.stands`), or it does not do what it is told.
    refused: bool = False


@dataclass
class Monitor:
    """The monitor of the vehicle's health, updated look by look."""

    timeouts: Timeouts = field(default_factory=Timeouts)
    health: Health = Health.INIT
    _better: int = 0  # looks in a row that would allow a better state
    _doubts: int = 0

    def look(self, senses: Senses) -> tuple[Health, Fault]:
        """Update the health; return it with the faults. Call it at a steady rate."""
        missing = self._missing(senses)
        faults = senses.faults | missing if missing else senses.faults
        wanted = self._wanted(senses, faults)
        if wanted >= self.health or self.health <= Health.OK:
            self.health, self._better = wanted, 0
        else:
            self._better += 1
            if self._better >= LOOKS:
                self.health, self._better = wanted, 0
        return self.health, faults

    @property
    def contradicted(self) -> bool:
        """Whether corners contradict the estimate more often than not."""
        return self._doubts >= _OFTEN

    def corners(self, believed: bool) -> None:
        """Count a frame whose corners were believed, or were not."""
        self._doubts = max(self._doubts - 1, 0) if believed else min(self._doubts + 1, 2 * _OFTEN)

    def _missing(self, senses: Senses) -> Fault:
        limits, located = self.timeouts, senses.located
        stale = [age_s > limits.camera_stale_s for age_s in senses.cameras_age_s]
        unsure = senses.decided and not senses.position_sigma_m <= limits.position_sigma_m
        faults = _NO_FAULT
        for is_so, fault in (
            (any(stale), Fault.CAMERA_STALE),
            (stale and all(stale), Fault.CAMERAS_STALE),
            (senses.odometry_age_s > limits.odometry_stale_s, Fault.ODOMETRY_STALE),
            (senses.restarts > MOST_RESTARTS, Fault.RESTARTED_OFTEN),
            (located and senses.fix_age_s > limits.flag_s, Fault.NO_MARKER),
            (located and unsure, Fault.UNSURE),
            (located and senses.distance_m > limits.distance_m, Fault.FAR_FROM_FIX),
        ):
            if is_so:
                faults |= fault
        return faults

    def _wanted(self, senses: Senses, faults: Fault) -> Health:
        limits = self.timeouts
        if faults & _BROKEN or senses.refused:
            return Health.STOP
        if not senses.located or (senses.decided and not senses.confirmed):
            return Health.INIT
        without_odometry = (
            senses.odometry_age_s > limits.blind_s or Fault.ODOMETRY_DOUBTFUL in faults
        )
        blind = without_odometry and senses.fix_age_s > limits.blind_s
        if senses.fix_age_s > limits.stop_s or blind or faults & _LOST:
            return Health.STOP
        twins = Fault.DUPLICATE_MARKER in faults and not senses.decided
        if senses.fix_age_s > limits.slow_s or faults & _SLOW or self.contradicted or twins:
            return Health.DEGRADED
        if Fault.NO_MARKER in faults:
            return Health.DEAD_RECKONING
        return Health.OK if senses.decided else Health.ALIGNED
