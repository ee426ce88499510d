"""What disturbs the picture of a marker: the edge of a shadow across it, and what hides a part."""

import math
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnav.detection.paper import library
from jaxnav.detection.pattern_fit import bounded_loss

_ANGLES, _OFFSETS = 16, 9
_SOFT = (0.03, 0.12, 0.3)  # widths of a penumbra, half sides
_REFINED = 3  # times: steps of angle and offset halved, a light fitted to what it explains
_GAINS = (0.15, 0.9)  # of a shadow's light, over that beside it
_SHADES = np.geomspace(0.15, 2, 16)  # gains that are tried
_ALIKE = 9.0  # a loss that counts as none: the most of one pixel
_LEAST_SHADED = 0.03  # of the pixels
_AS_MUCH = 0.6  # of the contrast that paper and ink have if a shadow dims them alike
_LEVELS = 24  # of paper and of ink, that are tried
_WIDTH = 0.08  # of what counts as the same level, of the contrast
_PLAIN = 0.4  # of a pixel's light more than a half: of paper or of ink alone, nearly
_PIXELS, _FEWEST = 256, 30  # that are compared, at most and at least
_HIDDEN = 3.5  # standard deviations
_GRID = 192  # pixels along a side: of a marker of 120 px, turned


def find_shadow(
    xy: Float[np.ndarray, "2 N"],
    levels: Float[np.ndarray, " N"],
    dark: Float[np.ndarray, " N"],
    scale: float,
) -> Float[np.ndarray, " N"] | None:
    """Where the light is, 1, and where a shadow, 0; None if no straight edge
    has less light on one side.

    Lines of all directions are tried, each with the levels of paper and ink that suit its sides and
    a gradient of the light, then the best one is turned, shifted and softened.

    Args:
        xy: places of the pixels on the paper.
        levels: grey levels of the pixels.
        dark: the share of each pixel's light that ink takes, by a fit without a shadow.
        scale: the noise of that fit, grey levels.
    """
    within = np.flatnonzero(np.all(np.abs(xy) < 1.1, axis=0) & np.isfinite(dark))[:_PIXELS]
    if len(within) < _FEWEST or not scale > 0:
        return None  # a fit that failed
    dark, levels, at = dark[within], levels[within], xy[:, within]
    ink = np.stack([1 - dark, dark])

    def losses(lines: np.ndarray) -> np.ndarray:
        """Loss (L,) of each line (angle, offset, softness), (L, 3)."""
        lit = _lit(at, lines)[:, None]
        gradient = np.broadcast_to(at * ink[0], (len(lines), *at.shape))
        basis = np.concatenate([lit * ink, (1 - lit) * ink, gradient], axis=1)
        weight = np.ones((len(lines), len(levels)))
        for _ in range(3):
            weighted = basis * weight[:, None]
            gram = weighted @ basis.transpose(0, 2, 1) + 1e-6 * len(levels) * np.eye(6)
            light = np.linalg.solve(gram, (weighted @ levels)[..., None])
            residual = (levels - np.sum(light * basis, axis=1)) / scale
            loss, weight = bounded_loss(residual)
        paper, ink_lit, paper_dim, ink_dim = light[:, :4, 0].T
        gain = paper_dim / np.maximum(paper, 1e-6)
        fair = (gain > _GAINS[0]) & (gain < _GAINS[1]) & (ink_lit < paper) & (ink_dim < paper_dim)
        return np.where(fair, np.sum(loss, axis=1), np.inf)

    angles = np.arange(_ANGLES) * 2 * math.pi / _ANGLES
    offsets = np.linspace(-0.8, 0.8, _OFFSETS)
    lines = np.stack(np.meshgrid(angles, offsets, _SOFT[:1]), axis=-1).reshape(-1, 3)
    turn, shift = math.pi / _ANGLES, 0.1
    least = math.inf
    for _ in range(_REFINED + 1):
        trials = losses(lines)
        if np.min(trials) < least:
            least, best = float(np.min(trials)), lines[np.argmin(trials)]
        if not least < math.inf:
            return None
        steps = np.array([[turn, 0, 0], [-turn, 0, 0], [0, shift, 0], [0, -shift, 0]])
        others = [[best[0], best[1], soft] for soft in _SOFT]
        lines = np.concatenate([best + steps, others])
        turn, shift = turn / 2, shift / 2
    return _lit(xy, best[None])[0]


def in_one_light(
    xy: Float[np.ndarray, "2 N"],
    levels: Float[np.ndarray, " N"],
    dark: Float[np.ndarray, " N"],
    contrast: float,
) -> Bool[np.ndarray, " N"]:
    """The most pixels that one level of paper and one of ink explain, with a gradient.

    Args:
        xy: places of the pixels on the paper.
        levels: grey levels of the pixels.
        dark: the share of each pixel's light that ink takes.
        contrast: about that of the marker, grey levels.
    """
    width = _WIDTH * contrast
    plain = (np.abs(dark - 0.5) > _PLAIN) & np.all(np.abs(xy) < 1.2, axis=0)
    tried = np.linspace(levels.min(), levels.max(), _LEVELS)
    paper, ink = np.meshgrid(tried, tried)
    paper, ink = paper[paper - ink > 2 * width], ink[paper - ink > 2 * width]
    near = np.zeros(len(levels), bool)
    if not len(paper):
        return near
    off = levels[plain] - np.where(dark[plain] < 0.5, paper[:, None], ink[:, None])
    votes = np.sum(np.maximum(1 - (off / width) ** 2, 0), axis=1)
    near[plain] = np.abs(off[np.argmax(votes)]) < width
    basis = np.stack([1 - dark, dark, *((1 - dark) * xy)])
    for _ in range(_REFINED):
        light = np.linalg.lstsq(basis[:, near].T, levels[near], rcond=None)[0]
        near = np.abs(levels - light @ basis) < width
    return near


def find_shade(
    levels: Float[np.ndarray, " N"], seen: Any, lit: Bool[np.ndarray, " N"]
) -> Float[np.ndarray, " N"] | None:
    """How far each pixel is off as if it lay in a shadow, standard deviations; None if none does.

    The shadow may have any outline, and dim paper and ink by different factors. Of the lights that
    are tried that counts which explains most of the pixels that are not lit.

    Args:
        levels: grey levels of the pixels.
        seen: `PixelFit` of a fit to what is lit.
        lit: the pixels that fit.
    """
    parts, paper, ink = np.stack([seen.lit - seen.ink, seen.ink]), seen.dark < 0.3, seen.dark > 0.7
    white, black = (
        float(np.median(parts[i, c])) if np.any(c) else 0.0 for i, c in enumerate((paper, ink))
    )

    def is_fair(gain: np.ndarray) -> np.ndarray:
        contrast = gain[..., 0] * white - gain[..., 1] * black
        return np.asarray(contrast > _AS_MUCH * gain[..., 0] * (white - black))

    gains = np.stack(np.meshgrid(_SHADES, _SHADES), axis=-1).reshape(-1, 2)
    gains = gains[is_fair(gains)]
    if not len(gains):
        return None
    near = (np.abs(levels - gains @ parts) < _HIDDEN * seen.deviation) & ~lit
    best = near[np.argmax(np.minimum(*(np.sum(near & cells, axis=1) for cells in (paper, ink))))]
    for _ in range(_REFINED):
        if min(np.sum(best & paper), np.sum(best & ink)) < _LEAST_SHADED * len(levels):
            return None
        weight = 1 / seen.deviation[best]
        gain = np.linalg.lstsq((weight * parts[:, best]).T, weight * levels[best], rcond=None)[0]
        off = (levels - gain @ parts) / seen.deviation
        best = (np.abs(off) < _HIDDEN) & ~lit
    return np.asarray(off) if _GAINS[0] < gain[0] < _GAINS[1] and is_fair(gain) else None


def _lit(xy: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """The light (L, N), 0 to 1, beside lines of (angle, offset, softness), (L, 3)."""
    angle, offset, soft = lines.T[:, :, None]
    beside = np.cos(angle) * xy[0] + np.sin(angle) * xy[1] - offset
    return np.asarray(1 / (1 + np.exp(-np.clip(beside / soft, -30, 30))))


def clear_pixels(
    pixels: Int[np.ndarray, "N 2"], residual: Float[np.ndarray, " N"]
) -> Bool[np.ndarray, " N"]:
    """Which pixels show the marker: those that fit, and have no neighbour that does not.

    At the edge of what hides a marker pixels are mixed and may fit by chance. A pixel that does not
    fit, and has no neighbour that does not either, is noise and hides nothing.

    Args:
        residual: of each pixel, over the noise.
    """
    grid, at = _on_grid(pixels, np.abs(residual) > _HIDDEN, _spacing(pixels))
    lumps = grid * ((_neighbours(grid) > 0) | (grid > 1))
    return np.asarray((lumps + _neighbours(lumps))[at] == 0)


def more_alike(
    pixels: Int[np.ndarray, "N 2"],
    one: Float[np.ndarray, " N"],
    other: Float[np.ndarray, " N"],
) -> Bool[np.ndarray, " N"]:
    """Which pixels, with their neighbours, one of two residuals explains as well as the other."""
    gain = bounded_loss(other)[0] - bounded_loss(one)[0]
    grid, at = _on_grid(pixels, gain, _spacing(pixels))
    for _ in range(2):
        grid = grid + _neighbours(grid)
    return np.asarray(grid[at] > -_ALIKE)


def noise_correlation(
    pixels: Float[Array, "N 2"],
    residual: Float[Array, " N"],
    share: Float[Array, " N"],
) -> Float[Array, ""]:
    """The factor of the variances by which the noise of neighbouring pixels is alike, at least 1.

    Sensors have white noise, but what makes colours of a raw picture or compresses it does not
    keep it so: the sum of a residual's correlations with its eight neighbours and itself.

    Args:
        residual: of each pixel, in its standard deviations.
        share: by how much a pixel counts, 0 to 1.
    """
    column, row = jnp.rint(pixels - jnp.min(pixels, axis=0)[None]).astype(int).T + 1
    grids = jnp.zeros((_GRID, _GRID, 2), residual.dtype)
    grids = grids.at[column, row].add(jnp.stack([share * residual, share], axis=1), mode="drop")
    beside, shares = _neighbours(grids)[column, row].T
    pairs = jnp.sum(shares * share)
    product, square = (jnp.sum(share * residual * other) for other in (beside, share * residual))
    found = (pairs > 0) & (square > 0)
    variance = square / jnp.maximum(jnp.sum(share**2), 1e-9)
    factor = 1 + 8 * product / jnp.where(found, pairs * variance, 1)
    return jnp.where(found, jnp.maximum(factor, 1), 1)


def _spacing(pixels: np.ndarray) -> float:
    """Mean distance between neighbouring pixels, some of which may have been left out, px."""
    width, height = cv2.minAreaRect(pixels.astype(np.float32))[1]
    return max(1.0, math.sqrt((width + 1) * (height + 1) / len(pixels)))


def _on_grid(
    pixels: np.ndarray, values: np.ndarray, spacing: float = 1.0
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Values (N,) of pixels on a grid with an empty border, and their places on it."""
    column, row = (np.floor((pixels - pixels.min(axis=0)) / spacing).astype(int) + 1).T
    grid = np.zeros((column.max() + 2, row.max() + 2))
    np.add.at(grid, (column, row), values)
    return grid, (column, row)


def _neighbours(grid: Any) -> Any:
    """The sum of the eight neighbours of each place of a grid (NumPy's or JAX's) with an empty
    border."""
    roll = library(grid).roll
    rows = grid + roll(grid, 1, axis=0) + roll(grid, -1, axis=0)
    return rows + roll(rows, 1, axis=1) + roll(rows, -1, axis=1) - grid
