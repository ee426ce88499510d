"""The line that `jaxnav run` writes in the terminal, and notices of what begins to go wrong."""

import math
import sys

from jaxnav.commands.drive.observers import WIDTH, DriveObserver
from jaxnav.core.models.origin import ZERO
from jaxnav.drive.flags import Fault
from jaxnav.drive.pilot import Input, Outcome

_WIDEST_NAME = 14  # of a health
_FAR = 12  # of a coordinate to the cm, 10 000 km from zero
_STATUS_NS = 200_000_000
_MARKER_NS = 200_000_000  # a marker counts as seen for this long
_PARTS = Fault.DRIVE_CONTRADICTED, Fault.SIDEWAYS_CONTRADICTED, Fault.TURN_CONTRADICTED
_PARTS_OF_A_CAR = "throttle", "to the left", "steering"
_PARTS_OF_A_BASE = "ahead", "to the left", "turn"
_NOTICES = {
    Fault.RELOCATED: "not where its wheels can have brought it: {reason}",
    Fault.WAYS_DISPUTED: "corners and odometer tell of different ways: a marker moves, or wheels "
    "slip",
    Fault.ODOMETRY_DOUBTFUL: "no marker in view, and the odometer contradicts the {command}",
    Fault.GYRO_INVALID: "the gyro's readings are not finite, at its limit, repeated or noise: left "
    "out",
    Fault.GYRO_CONTRADICTED: "the gyro contradicts wheels and corners: left out",
    _PARTS[0] | _PARTS[1] | _PARTS[2]: "it does not move as it is told ({parts}): reversed, dead "
    "or miswired",
    Fault.LEFT_ROUTE: "farther from its route than leave_m: it stands",
    Fault.GYRO_STALE: "the gyro tells nothing: the drive goes on without it",
    Fault.MARKER_OUTVOTED: "marker {markers} is not where the others say: left out",
    Fault.CAMERA_OUTVOTED: "the camera {cameras} does not see markers where another does: left out",
}


class StatusLine(DriveObserver):
    """An observer that writes one line in the terminal, five times a second."""

    def __init__(self) -> None:
        self._last_ns, self._count, self._marker_ns = 0, 0, 0
        self._faults = Fault(0)

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
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

    def close(self) -> None:
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
    if Fault.ODOMETRY_STALE in outcome.faults:  # the whole vehicle tells nothing
        new &= ~Fault.GYRO_STALE
    is_car = outcome.twist is None
    parts = zip(_PARTS, _PARTS_OF_A_CAR if is_car else _PARTS_OF_A_BASE, strict=True)
    words = {
        "reason": outcome.restart_reason,
        "command": "throttle" if is_car else "command",
        "parts": ", ".join(name for part, name in parts if part in new),
        "markers": ", ".join(map(str, outcome.outvoted)),
        "cameras": ", ".join(outcome.outvoted_cameras),
    }
    notices = [text.format(**words) for faults, text in _NOTICES.items() if faults & new]
    return "; ".join(notices) or None
