"""Which code of a family a fitted marker shows: the predicted one, and by how much."""

from functools import cache

import numpy as np
from jaxtyping import Float

from jaxnav.detection.families import all_cells, codes_of
from jaxnav.detection.image_model import PIXEL_VARIANCE_PX2
from jaxnav.detection.paper import blur_on_paper, on_paper
from jaxnav.detection.pattern_fit import PatternFit, Window

_NODES = 4


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
    codes, products = codes_of(family), code_products(family)
    along = frame @ levels + codes @ (cells @ levels)
    gram = cells @ cells.T
    upper = np.triu_indices(len(gram))
    twice = np.where(upper[0] == upper[1], 1.0, 2.0)
    length = frame @ frame + 2 * codes @ (cells @ frame) + products @ (twice * gram[upper])
    explained = np.minimum(along, 0) ** 2 / np.maximum(length, 1e-9)
    own = 4 * marker_id
    return float(explained[own] - np.max(np.delete(explained, own)))


@cache
def code_products(family: str) -> Float[np.ndarray, "codes pairs"]:
    """For each code of `codes_of`, the products of its cells' ink, (codes, pairs of cells)."""
    codes = codes_of(family)
    i, j = np.triu_indices(codes.shape[1])
    return (codes[:, i] * codes[:, j]).astype(np.float32)


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
