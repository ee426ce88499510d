"""Which code of a family a fitted marker shows: the predicted one, and by how much."""

import numpy as np
from jaxtyping import Bool, Float

from jaxnav.detection.families import all_cells, codes_of
from jaxnav.detection.image_model import PIXEL_VARIANCE_PX2
from jaxnav.detection.paper import blur_on_paper, on_paper
from jaxnav.detection.pattern_fit import PatternFit, Window

_NODES = 4  # images of a moving marker that are averaged
_NEAR = 96  # codes that are drawn
_BOUND = 9.0  # of a pixel's loss, noise variances
_MOST = 10.0  # standard deviations, of a pixel that helps to choose them


def code_advantage(
    family: str,
    marker_id: int,
    fit: PatternFit,
    window: Window,
    shown: Bool[np.ndarray, " N"],
) -> float:
    """By how many noise variances every other code, in any quarter turn, is worse than this one.

    Every code is drawn through the blur, the homography and the light of the fit, and compared with
    pixels that the fit left out as well: what hides a marker in the eyes of one code may be another
    code. The loss of a pixel is bounded. Negative if another code is better.

    Args:
        shown: which of the window's first pixels count.
    """
    n = all_cells(family).shape[1]
    count = len(shown)
    ink = cell_images(fit, window, n)[:, :count]
    inside = np.pad(np.ones((n - 2, n - 2), bool), 1).ravel()
    frame, cells = ink[~inside].sum(axis=0), ink[inside]
    codes, own = codes_of(family), 4 * marker_id
    # By a pixel's own noise: what it would be without ink, and by how much ink darkens it.
    noise = np.asarray(fit.deviation, float)[:count]
    light = (
        np.asarray(window.levels, float)[:count] - np.asarray(fit.white, float)[:count]
    ) / noise
    darkens = np.asarray(fit.darkens, float)[:count] / noise
    # To draw all codes would take some milliseconds: those that correlate best suffice, with what
    # remains where all cells are grey.
    half = frame + cells.sum(axis=0) / 2
    bend = float(fit.bend) * shown / noise
    grey = light + darkens * half - bend * half * (1 - half)
    alike = codes @ (cells @ (darkens * np.clip(grey, -_MOST, _MOST)))
    near = np.argpartition(alike, min(_NEAR, len(alike) - 1))[:_NEAR]
    near = np.append(near[near != own], own)
    drawn = frame + codes[near] @ cells
    residual = light + darkens * drawn - bend * drawn * (1 - drawn)
    losses = np.sum(residual**2 / (1 + residual**2 / _BOUND), axis=1)
    return float(np.min(losses[:-1]) - losses[-1])


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
