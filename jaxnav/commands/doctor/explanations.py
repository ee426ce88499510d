"""Search for one error that would explain the corners: a size, a moved marker, a lens, a camera."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from jaxnav.commands.doctor.fits import MOST_ERRORS, FileErrors, Sighted, StandingFit, fit

SIZE_SIGMA = 0.3  # of a logarithm
_FOCAL_SIGMA = 0.1
_MOVED_SIGMA = 1.0  # m and rad
_TURNED_SIGMA_RAD = 0.1
# The most an explanation may leave: a share of the chi-square, and an RMS error of the corners.
_EXPLAINS, _MOST_PX = 0.1, 1.0
_SCALED_ALIKE = 0.01  # sizes that a printer scaled agree this well
_ALIKE = 6.0  # two explanations this close can't be told apart


@dataclass(frozen=True)
class Explanation:
    """One error that a file may hold, with the best fit that allows for it.

    Attributes:
        kind: "size", "sizes", "moved", "focal" or "turned".
        index: of the marker or the camera; None for all of them.
        count: how many numbers it frees.
        fit: the best fit with these numbers free.
    """

    kind: str
    index: int | None
    count: int
    fit: StandingFit = field(repr=False)


def explained(seen: Sighted, starts: Sequence[np.ndarray], whole: StandingFit) -> list[Explanation]:
    """The errors that explain the corners best: up to three that can't be told apart, often none.

    Args:
        starts: level poses to begin at.
        whole: the fit without any error.
    """
    tried = [
        Explanation(kind, index, count, fit(seen, starts, prior_sigma))
        for kind, index, count, prior_sigma in _errors_of_files(seen)
    ]
    good = [
        each
        for each in tried
        if each.fit.cost < _EXPLAINS * whole.cost
        and each.fit.error_px < _MOST_PX
        and (each.kind != "sizes" or np.ptp(each.fit.value.size) < _SCALED_ALIKE)
    ]
    misfit = min((max(each.fit.cost / seen.numbers, 1.0) for each in good), default=1.0)

    def price(each: Explanation) -> float:
        """Schwarz's criterion (1978): the misfit left, and a penalty for each number freed."""
        return each.fit.cost / misfit + each.count * math.log(seen.numbers)

    good.sort(key=price)
    return [each for each in good if price(each) < price(good[0]) + _ALIKE][:3]


def _errors_of_files(seen: Sighted) -> Iterator[tuple[str, int | None, int, FileErrors]]:
    """Each error that several markers can tell apart: kind, index, count, and prior sigmas."""
    C, M = seen.visible.shape
    used = np.flatnonzero(seen.visible.any(axis=1))[:MOST_ERRORS]

    def of_pose(**others: np.ndarray) -> FileErrors:
        return FileErrors.of_pose(seen, level=True, **others)

    yield "sizes", None, M, of_pose(size=np.full(M, SIZE_SIGMA))
    focal = np.where(np.isin(np.arange(C), used), _FOCAL_SIGMA, 0.0)
    yield "focal", None, len(used), of_pose(focal=focal)
    for m in range(M):
        this = np.arange(M) == m
        yield "size", m, 1, of_pose(size=np.where(this, SIZE_SIGMA, 0.0))
        moved = np.where(this[:, None], _MOVED_SIGMA, 0.0) * np.ones(6)
        yield "moved", m, 6, of_pose(moved=moved)
    if len(used) > 1:
        for c in used.tolist():
            this = np.arange(C) == c
            turned = np.where(this[:, None], _TURNED_SIGMA_RAD, 0.0) * np.ones(3)
            yield "turned", c, 3, of_pose(turned=turned)


def in_words(seen: Sighted, explanation: Explanation) -> tuple[str, str]:
    """An explanation as text, and what to do about it."""
    value, index = explanation.fit.value, explanation.index
    ids, names = seen.markers.ids, seen.rig.names
    if index is None:
        if explanation.kind == "sizes":
            factors = ", ".join(
                f"{marker_id} {math.exp(float(size)):.3f}"
                for marker_id, size in zip(ids, value.size, strict=True)
            )
            return (
                f"markers have other sizes than in the map: {factors} times",
                "measure the black squares: did the printer scale the page?",
            )
        factors = ", ".join(
            f"{names[c]} {math.exp(float(value.focal[c])):.3f}"
            for c in np.flatnonzero(seen.visible.any(axis=1))
        )
        return (
            f"focal lengths are other than in the rig: {factors} times",
            "calibrate the lenses again, at the image size that the car uses",
        )
    if explanation.kind == "size":
        factor, size_m = math.exp(float(value.size[index])), float(seen.markers.size_m[index])
        return (
            f"marker {ids[index]} is {factor:.3f} of its size in the map",
            f"measure its black square: is it {size_m * factor:.4f} m instead of {size_m:.4f}?",
        )
    if explanation.kind == "moved":
        shift_m = float(np.linalg.norm(value.moved[index, :3]))
        turn_deg = math.degrees(float(np.linalg.norm(value.moved[index, 3:])))
        return (
            f"marker {ids[index]} is moved by {shift_m:.3f} m and {turn_deg:.0f} deg",
            f"measure the corners of marker {ids[index]} again",
        )
    turn_deg = math.degrees(float(np.linalg.norm(value.turned[index])))
    return (
        f"camera {names[index]} is turned by {turn_deg:.1f} deg",
        f"measure yaw_deg, elevation_deg and roll_deg of {names[index]} again",
    )
