"""Which code of a family a fitted marker shows: the predicted one, and by how much."""

import numpy as np
from jaxtyping import Float

from jaxnav.detection.families import all_cells, codes_of
from jaxnav.detection.image_model import PIXEL_VARIANCE_PX2
from jaxnav.detection.paper import blur_on_paper, on_paper
from jaxnav.detection.pattern_fit import PatternFit, Window

_NODES = 4  # images of a moving marker that are averaged
_NEAR = 64  # codes that are compared exactly


def code_advantage(
    family: str, marker_id: int, fit: PatternFit, window: Window, count: int
) -> float:
    """By how many noise variances every other code, in any quarter turn, is worse than this one.

    Every code is compared through the blur and the homography of the fit, with the light that suits
    it best. Negative if another code is better.

    Args:
        count: number of the window's pixels that are not padding.
    """
    n = all_cells(family).shape[1]
    ink = cell_images(fit, window, n)[:, :count]
    weight = np.sqrt(np.asarray(fit.weight, float)[:count] / float(fit.noise) ** 2)
    (x, y), _ = on_paper(np.asarray(fit.M, float), *_rays(window))
    ground = np.stack([np.ones(count), x[:count], y[:count]]) * weight
    base, _ = np.linalg.qr(ground.T)

    def without_ground(rows: np.ndarray) -> np.ndarray:
        return rows - (rows @ base) @ base.T

    inside = np.pad(np.ones((n - 2, n - 2), bool), 1).ravel()
    levels = without_ground(np.asarray(window.levels, float)[:count] * weight)
    cells = without_ground(ink * weight)
    frame, cells = cells[~inside].sum(axis=0), cells[inside]
    codes, own = codes_of(family), 4 * marker_id
    along = frame @ levels + codes @ (cells @ levels)
    # The lengths of all would take a millisecond, and differ little: those that fit best suffice.
    near = np.argpartition(along, min(_NEAR, len(along) - 1))[:_NEAR]
    near = np.append(near[near != own], own)
    gram, across = cells @ cells.T, cells @ frame
    length = frame @ frame + np.sum((2 * across + codes[near] @ gram) * codes[near], axis=1)
    explained = np.minimum(along[near], 0) ** 2 / np.maximum(length, 1e-9)
    return float(explained[-1] - np.max(explained[:-1]))


def cell_images(fit: PatternFit, window: Window, n: int) -> Float[np.ndarray, "cells N"]:
    """The share of each pixel's light that comes from each cell, (n * n, N)."""
    rays, rays_px = _rays(window)
    motion_px = np.asarray(fit.motion_px, float)
    M = np.asarray(fit.M, float)
    between = motion_px / _NODES
    S = np.array([between[0] ** 2, between[0] * between[1], between[1] ** 2]) / 12
    S = S + (float(fit.lens_px2) + PIXEL_VARIANCE_PX2) * np.array([1, 0, 1])
    knots = np.linspace(-1, 1, n + 1)[:, None]
    images = np.zeros((n * n, rays.shape[1]))
    for time in (np.arange(_NODES) + 0.5) / _NODES - 0.5:
        xy, xy_px = on_paper(M, rays - time * np.tensordot(motion_px, rays_px, 1), rays_px)
        sigma = np.sqrt(blur_on_paper(xy_px, S)[:2])
        # A logistic curve is within 0.01 of the Gaussian integral: enough to read cells.
        z = np.clip((xy[:, None] - knots) / sigma[:, None], -20, 20)
        columns, rows = -np.diff(1 / (1 + np.exp(-1.702 * z)), axis=1)
        images += (rows[:, None] * columns[None]).reshape(n * n, -1) / _NODES
    return images


def _rays(window: Window) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(window.rays, float), np.asarray(window.rays_px, float)
