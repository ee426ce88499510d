"""First guess of a lens for its fit: OpenCV's calibration, or one from a list of focal lengths.

OpenCV's fisheye calibration throws at ill-conditioned views and often at very wide lenses. So focal
lengths without distortion are tried as well, and the guess with the least median residual is taken.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxnav.calibrate.board.views import BoardView, BoardViews, pose_from_rays, unproject
from jaxnav.calibrate.lens import bundle as lens_bundle

_FOCALS = np.geomspace(0.2, 3.0, 14)  # in image widths: 140 degrees and more, to a tele lens
_MOST_VIEWS = 24  # OpenCV's time grows with the cube of their number
# Coefficients of wide lenses that OpenCV does not calibrate, typical ones; others start at zero.
_TYPICAL = {"omni": (1.0,), "double_sphere": (0.0, 0.6), "eucm": (0.6, 1.0)}


def lens_start(views: BoardViews, lens: str) -> tuple[Float[np.ndarray, " 9"], float]:
    """Find (9,) fx fy cx cy and coefficients that explain most of the corners roughly.

    Also return the median distance of a corner from its prediction, px.
    """
    some = np.unique(np.linspace(0, len(views.views) - 1, _MOST_VIEWS).round().astype(int))
    few = replace(views, views=tuple(views.views[i] for i in some))
    width, height = views.image_size_px
    guess = np.zeros(lens_bundle.COUNT)
    typical = _TYPICAL.get(lens, ())
    guess[: 4 + len(typical)] = [1.0, 1.0, (width - 1) / 2, (height - 1) / 2, *typical]
    on_axis_px, _ = lens_bundle.axis_px(lens, jnp.asarray(guess))
    guesses = np.tile(guess, (len(_FOCALS), 1))
    guesses[:, :2] = _FOCALS[:, None] * width / np.asarray(on_axis_px)
    candidates = [*guesses, *(() if typical else _opencv(few, lens))]
    misfits_px = [_misfit_px(few, lens, candidate) for candidate in candidates]
    best = int(np.argmin(misfits_px))
    return candidates[best], misfits_px[best]


def board_poses(
    views: BoardViews, lens: str, parameters: Float[np.ndarray, " 9"]
) -> Float[np.ndarray, "V 7"]:
    """(V, 7) T_camera_board of every view, found from that view alone; NaN where none is found.

    Corners become rays, and the rays are projected into a pinhole camera that looks at their
    middle, whatever its angle to the real axis. Of IPPE's two poses, that of lower error is taken.

    Source: Collins and Bartoli (2014), "Infinitesimal plane-based pose estimation", by OpenCV.
    """
    corners_px = jnp.asarray(lens_bundle.padded_corners(views).corners_px)
    camera = lens_bundle.camera_of(lens, jnp.asarray(parameters, float))
    rays = np.asarray(unproject(camera, corners_px))
    poses = [
        pose_from_rays(views.points_board_m[view.ids], rays[row, view.ids])
        for row, view in enumerate(views.views)
    ]
    return np.reshape(poses, (-1, 7))


def _misfit_px(views: BoardViews, lens: str, parameters: np.ndarray) -> float:
    """Median distance of a corner from its prediction, px; infinite if half have no pose."""
    poses = board_poses(views, lens, parameters)
    lost = np.isnan(poses[:, 0])
    seen, unknowns = lens_bundle.padded(views, parameters, poses)
    residual_px = np.linalg.norm(lens_bundle.residuals_px(lens, unknowns, seen), axis=2)
    residual_px[: len(lost)][lost] = np.inf
    return float(np.median(residual_px[np.asarray(seen.present)]))


def _opencv(views: BoardViews, lens: str) -> Iterator[np.ndarray]:
    """Yield OpenCV's calibration, if it finds a finite one."""
    usable = [view for view in views.views if len(view.ids) >= 6]
    try:
        matrix, coefficients = opencv_calibration(views, usable, lens)
    except cv2.error:
        return
    parameters = np.zeros(lens_bundle.COUNT)
    parameters[:4] = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    parameters[4 : 4 + len(coefficients)] = coefficients
    if np.all(np.isfinite(parameters)) and np.all(parameters[:2] > 0):
        yield parameters


def opencv_calibration(
    views: BoardViews, usable: Sequence[BoardView], lens: str
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " coefficients"]]:
    """Calibrate by cv2.calibrateCamera or cv2.fisheye.calibrate: matrix (3, 3) and coefficients.

    Raises:
        cv2.error: OpenCV fails, which is frequent with fisheye.calibrate.
    """
    # OpenCV's boards lie in z = 0, and it starts from homographies, whether mirrored or not.
    points = [views.points_board_m[view.ids].astype(np.float32) for view in usable]
    corners = [view.corners_px.astype(np.float32) for view in usable]
    if lens == "equidistant":
        _, matrix, coefficients, _, _ = cv2.fisheye.calibrate(
            [p.reshape(1, -1, 3) for p in points],
            [c.reshape(1, -1, 2) for c in corners],
            views.image_size_px,
            np.eye(3),
            np.zeros(4),
            flags=_fisheye_flag("CALIB_RECOMPUTE_EXTRINSIC") | _fisheye_flag("CALIB_FIX_SKEW"),
        )
        return np.asarray(matrix), np.ravel(coefficients)
    fixed = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    _, matrix, coefficients, _, _ = cv2.calibrateCamera(
        points,
        corners,
        views.image_size_px,
        np.eye(3),
        np.zeros(5),
        flags=fixed if lens == "none" else 0,
    )
    return np.asarray(matrix), np.ravel(coefficients)[: 0 if lens == "none" else 5]


def _fisheye_flag(name: str) -> int:
    """The flag's value: OpenCV 5 has one set for all lenses, OpenCV 4 another for the fisheye."""
    return int(getattr(cv2.fisheye, name, None) or getattr(cv2, name))
