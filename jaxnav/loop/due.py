"""Predict how corners move in the images when the vehicle moves."""

import math

import numpy as np

from jaxnav.loop.expect import expect_corners
from jaxnav.loop.way import Place
from jaxnav.navigator import Navigator


def due_px(
    navigator: Navigator, pose: np.ndarray | None, motion: Place
) -> tuple[np.ndarray, np.ndarray] | None:
    """Corners before and after a motion, (C, M, 4, 2) each; None where the pose is not known.

    Args:
        pose: estimated (x_m, y_m, psi_rad) after the motion. Its error matters little: the relative
            error of a shift is that of the distance to the marker.
        motion: (x_m, y_m, psi_rad) in the vehicle's axes before the motion.
    """
    if pose is None:
        return None
    x_m, y_m, psi_rad = map(float, pose)
    before_rad = psi_rad - motion[2]
    c, s = math.cos(before_rad), math.sin(before_rad)
    before = (
        x_m - c * motion[0] + s * motion[1],
        y_m - s * motion[0] - c * motion[1],
        before_rad,
    )
    return _quads_px(navigator, before), _quads_px(navigator, (x_m, y_m, psi_rad))


def _quads_px(navigator: Navigator, place: Place) -> np.ndarray:
    """Corners as seen from a place, (C, M, 4, 2), by the program that predicts search regions."""
    (x_m, y_m, psi_rad), dtype = place, np.asarray(navigator.corner_sigma_px).dtype
    wxyz_xyz = np.array([math.cos(psi_rad / 2), 0, 0, math.sin(psi_rad / 2), x_m, y_m, 0], dtype)
    corners = expect_corners(navigator.rig, navigator.markers, wxyz_xyz, np.zeros((3, 3), dtype))
    return np.asarray(corners.quads_px)
