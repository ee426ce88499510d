"""What disturbs the picture of a marker: the edge of a shadow across it, and what hides a part."""

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxnav.detection.pattern_fit import PatternFit

_ANGLES, _OFFSETS = 16, 9
_SOFT = (0.03, 0.12, 0.3)  # widths of a penumbra, half sides
_REFINED = 3  # halvings of the steps of angle and offset
_GAINS = (0.15, 0.9)  # of a shadow's light, over that beside it
_BETTER = 0.75  # a shadow must lower the loss to this part
_WIDTH = 3.0  # of the loss, standard deviations
_HIDDEN = 3.5  # standard deviations


def find_shadow(
    xy: Float[np.ndarray, "2 N"], levels: Float[np.ndarray, " N"], fit: PatternFit
) -> Float[np.ndarray, " N"] | None:
    """Where the light is, 1, and where a shadow, 0; None if no straight edge explains the pixels.

    Lines of all directions are tried, each with the two lights that suit its sides, then the best
    one is turned, shifted and softened.

    Args:
        xy: places of the pixels on the paper.
        levels: grey levels of the pixels.
        fit: a fit of the marker without a shadow, whose arrays may be longer than the pixels.
    """
    count = len(levels)
    marker, noise = np.asarray(fit.marker, float)[:count], float(fit.noise)
    within = np.all(np.abs(xy) < 1.1, axis=0)
    scale = noise + 0.02 * float(fit.contrast)

    def loss(angle: float, offset: float, soft: float) -> float:
        lit = _lit(xy, angle, offset, soft)
        sides = np.stack([marker * lit, marker * (1 - lit)])[:, within]
        weight = np.ones(sides.shape[1])
        for _ in range(3):
            weighted = sides * weight
            gram = weighted @ sides.T + 1e-6 * np.eye(2) * np.sum(sides**2)
            gains = np.linalg.solve(gram, weighted @ levels[within])
            residual = (levels[within] - gains @ sides) / scale
            weight = 1 / (1 + (residual / _WIDTH) ** 2) ** 2
        if not _GAINS[0] < gains[1] / max(gains[0], 1e-6) < _GAINS[1]:
            return math.inf
        return float(np.sum(residual**2 / (1 + (residual / _WIDTH) ** 2)))

    plain = np.asarray(fit.residual, float)[:count][within] / scale
    without = float(np.sum(plain**2 / (1 + (plain / _WIDTH) ** 2)))
    trials = [
        (loss(angle, offset, _SOFT[0]), angle, offset, _SOFT[0])
        for angle in np.arange(_ANGLES) * 2 * math.pi / _ANGLES
        for offset in np.linspace(-0.8, 0.8, _OFFSETS)
    ]
    best = min(trials)
    turn, shift = math.pi / _ANGLES, 0.1
    for _ in range(_REFINED):
        _, angle, offset, soft = best
        near = [(angle + turn, offset, soft), (angle - turn, offset, soft),
                (angle, offset + shift, soft), (angle, offset - shift, soft)]  # fmt: skip
        near += [(angle, offset, other) for other in _SOFT if other != soft]
        best = min([best, *((loss(*line), *line) for line in near)])
        turn, shift = turn / 2, shift / 2
    if not best[0] < _BETTER * without:
        return None
    return _lit(xy, *best[1:])


def _lit(xy: np.ndarray, angle: float, offset: float, soft: float) -> np.ndarray:
    beside = math.cos(angle) * xy[0] + math.sin(angle) * xy[1] - offset
    return np.asarray(1 / (1 + np.exp(-np.clip(beside / soft, -30, 30))))


def clear_pixels(pixels: Int[np.ndarray, "N 2"], fit: PatternFit) -> Bool[np.ndarray, " N"]:
    """Which pixels show the marker: those that fit, and have no neighbour that does not.

    At the edge of what hides a marker pixels are mixed and may fit by chance. A pixel that does not
    fit, and has no neighbour that does not either, is noise and hides nothing.
    """
    count = len(pixels)
    off = np.abs(np.asarray(fit.residual, float)[:count]) > _HIDDEN * float(fit.noise)
    low = pixels.min(axis=0) - 1
    size = pixels.max(axis=0) - low + 2
    grid = np.zeros(size)
    at = tuple((pixels - low).T)
    grid[at] = off
    around = np.zeros_like(grid)
    for shift in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        around += np.roll(grid, shift, axis=(0, 1))
    lumps = np.where((grid > 0) & (around > 0), 1.0, 0.0)
    hidden = lumps.copy()
    for shift in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        hidden += np.roll(lumps, shift, axis=(0, 1))
    return np.asarray(hidden[at] == 0)
