"""The status line of a drive in the terminal, and notices of faults."""

import math

from jaxnav.loop.flags import Fault
from jaxnav.loop.pilot import Outcome
from jaxnav.models.origin import ZERO

WIDTH = 100  # characters, at most
_WIDEST_NAME = 14  # of a health
_FAR = 12  # of a coordinate to the cm, 10 000 km from zero


def status_line(outcome: Outcome, rate_hz: float, latency_ms: float, marker_seen: bool) -> str:
    """Rate, latency, health, marker, flip probability, position, command: at most 100 characters.

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
    if far:
        return " ".join(
            (
                f"{_fixed(rate_hz, 4, 0)}Hz",
                f"{_fixed(latency_ms, 5, 1)}ms",
                f"{outcome.health.name:<{_WIDEST_NAME}}",
                "marker" if marker_seen else "  --  ",
                f"flip{flip}%",
                f"x{x} y{y}{psi}",
                f"thr {_fixed(outcome.throttle, 6, 3)}",
                f"str {_fixed(math.degrees(outcome.steering_rad), 5, 1)}",
            )
        )
    return " ".join(
        (
            f"{_fixed(rate_hz, 4, 0)} Hz",
            f"{_fixed(latency_ms, 5, 1)} ms",
            f"{outcome.health.name:<{_WIDEST_NAME}}",
            "marker" if marker_seen else "  --  ",
            f"flip{flip}%",
            f"x{x} y{y} m{psi} deg",
            f"thr {_fixed(outcome.throttle, 6, 3)}",
            f"str {_fixed(math.degrees(outcome.steering_rad), 5, 1)} deg",
        )
    )


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
        reasons.append("no marker in view, and the odometer contradicts the throttle")
    if Fault.MARKER_OUTVOTED in new and outcome.outvoted:
        ids = ", ".join(map(str, outcome.outvoted))
        reasons.append(f"marker {ids} is not where the others say: left out")
    return "; ".join(reasons) or None
