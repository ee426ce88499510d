"""Checks of all markers in the pictures at once: do sizes, places, lenses and cameras agree?"""

import math
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np

from jaxnav.commands.doctor.explanations import SIZE_SIGMA, explained, in_words
from jaxnav.commands.doctor.findings import Finding
from jaxnav.commands.doctor.fits import FileErrors, Sighted, StandingFit, fit
from jaxnav.files import Route
from jaxnav.models.geometry import T_world_vehicle_from_planar
from jaxnav.models.origin import Origin

_FITS = 2.0  # chi-square for each number, up to which all is well
_SMALL_PX = 0.3  # an RMS this small is no error of a file either
_LEAST_SIZE = 0.03  # a smaller error of a size is not reported
_CLEARLY = 2.0  # sigma


def together(seen: Sighted, poses: Sequence[StandingFit], route: Route | None) -> Iterator[Finding]:
    """Report where the car stands, and which part of the files contradicts the rest.

    Args:
        seen: corners in the order of the print.
        poses: the pose by each marker alone.
    """
    starts = [_on_ground(pose) for pose in poses]
    whole = fit(seen, starts, FileErrors.of_pose(seen, level=True))
    if route is not None:
        yield _place(whole, route, seen.markers.origin_m)
    if len(seen.markers.ids) == 1:
        yield _size_alone(seen, starts)
        return
    text = (
        f"{len(seen.markers.ids)} markers together: corners are {whole.error_px:.2f} px off, "
        f"their scatter allows {seen.allowed_px:.2f}"
    )
    if whole.cost <= _FITS * seen.numbers or whole.error_px < _SMALL_PX:
        yield Finding("picture", "ok", text)
        return
    best = explained(seen, [*starts, _on_ground(whole)], whole)
    if not best:
        yield Finding(
            "picture",
            "warning",
            f"{text}, and no single error explains it",
            "calibrate the lenses, then measure the cameras' places and the markers' corners again",
        )
        return
    ways = " or ".join(in_words(seen, each)[0] for each in best)
    yield Finding(
        "picture",
        "error",
        f"{text}; {best[0].fit.error_px:.2f} if {ways}",
        in_words(seen, best[0])[1],
    )


def _on_ground(pose: StandingFit) -> np.ndarray:
    return np.asarray(T_world_vehicle_from_planar(jnp.asarray(pose.planar, float)).wxyz_xyz)


def _place(whole: StandingFit, route: Route, origin_m: Origin) -> Finding:
    x_m, y_m, psi_rad = whole.planar
    start = route.start_pose
    apart_m = math.hypot(x_m - start[0], y_m - start[1])
    turn_deg = math.degrees((psi_rad - start[2] + math.pi) % (2 * math.pi) - math.pi)
    return Finding(
        "picture",
        "ok",
        f"the car stands at x {origin_m[0] + x_m:.2f} m, y {origin_m[1] + y_m:.2f} m, "
        f"psi {round(math.degrees(psi_rad))} deg: "
        f"{apart_m:.2f} m and {round(turn_deg):+d} deg from the route's start",
    )


def _size_alone(seen: Sighted, starts: Sequence[np.ndarray]) -> Finding:
    """Check the size of a single marker: its height over the camera tells its distance, so size."""
    size = FileErrors.of_pose(seen, level=True, size=np.full(1, SIZE_SIGMA))
    standing_fit = fit(seen, starts, size)
    logarithm, sigma = float(standing_fit.value.size[0]), float(standing_fit.sigma.size[0])
    factor, written_m = math.exp(logarithm), float(seen.markers.size_m[0])
    text = f"marker {seen.markers.ids[0]} is {factor:.2f} (+- {sigma:.2f}) of its size in the map"
    if abs(logarithm) > max(_CLEARLY * sigma, _LEAST_SIZE):
        return Finding(
            "picture",
            "warning",
            f"{text}, if the camera's height and elevation are right",
            f"measure its black square: is it {written_m * factor:.4f} m instead of "
            f"{written_m:.4f}?",
        )
    return Finding("picture", "ok", text)
