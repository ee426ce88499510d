"""Which code of a family a fitted marker shows: the predicted one, and by how much."""

import numpy as np
from jaxtyping import Float

from jaxnav.detection.families import all_cells, codes_of
from jaxnav.detection.image_model import cell_shares
from jaxnav.detection.pattern_fit import PatternFit, Window, bounded_loss

_NODES = 4  # images of a moving marker that are averaged
_NEAR = 96  # codes that are drawn
_MOST = 10.0  # standard deviations, of a pixel that helps to choose them


def code_advantage(
    family: str,
    marker_id: int,
    fit: PatternFit,
    window: Window,
    count: int,
) -> float:
    """By how many noise variances every other code, in any quarter turn, is worse than this one.

    Every code is drawn through the blur, the homography and the light of the fit, and compared with
    pixels that the fit left out as well: what hides a marker in the eyes of one code may be another
    code. The loss of a pixel is bounded. Negative if another code is better.

    Args:
        count: number of the window's pixels that are not padding.
    """
    n = all_cells(family).shape[1]
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
    bend = float(fit.bend) / noise
    grey = light + darkens * half - bend * half * (1 - half)
    alike = codes @ (cells @ (darkens * np.clip(grey, -_MOST, _MOST)))
    near = np.argpartition(alike, min(_NEAR, len(alike) - 1))[:_NEAR]
    near = np.append(near[near != own], own)
    drawn = frame + codes[near] @ cells
    residual = light + darkens * drawn - bend * drawn * (1 - drawn)
    losses = np.sum(bounded_loss(residual)[0], axis=1)
    return float(np.min(losses[:-1]) - losses[-1])


def cell_images(fit: PatternFit, window: Window, n: int) -> Float[np.ndarray, "cells N"]:
    """The share of each pixel's light that comes from each cell of a moving marker, (n * n, N)."""
    rays, rays_px = np.asarray(window.rays, float), np.asarray(window.rays_px, float)
    M, motion_px = np.asarray(fit.M, float), np.asarray(fit.motion_px, float)
    between = motion_px / _NODES
    S = np.array([between[0] ** 2, between[0] * between[1], between[1] ** 2]) / 12
    S = S + float(fit.lens_px2) * np.array([1, 0, 1])
    images = np.zeros((n * n, rays.shape[1]))
    for time in (np.arange(_NODES) + 0.5) / _NODES - 0.5:
        shifted = rays - time * np.tensordot(motion_px, rays_px, 1)
        images += cell_shares(M, shifted, rays_px, S, n) / _NODES
    return images
