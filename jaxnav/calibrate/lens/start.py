"""First guess of a lens for its fit: OpenCV's calibration, or one from a list of focal lengths.

OpenCV's fisheye calibration throws at ill-conditioned views and often at very wide lenses. So focal
lengths without distortion are tried as well, and the guess with the least median residual is taken.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.views import BoardView, BoardViews

_FOCALS = np.geomspace(0.2, 3.0, 14)  # in image widths: 140 degrees and more, to a tele lens
_MOST_VIEWS = 24  # OpenCV's time grows with the cube of their number
_WIDEST = np.tan(np.deg2rad(80.0))  # from the middle of a view; steeper rays weigh too much
_FEWEST = 4  # points a pose can be found from
# Coefficients of wide lenses that OpenCV does not calibrate, typical ones; others start at zero.
_TYPICAL = {"omni": (1.0,), "double_sphere": (0.0, 0.6), "eucm": (0.6, 1.0)}


def lens_start(views: BoardViews, lens: str) -> tuple[Float[np.ndarray, " 9"], float]:
    """Find (9,) fx fy cx cy and coefficients that explain most of the corners roughly.

    Also return the median distance of a corner from its prediction, px.
    """
    some = np.unique(np.linspace(0, len(views.views) - 1, _MOST_VIEWS).round().astype(int))
    few = BoardViews(views.points_board_m, views.image_size_px, tuple(views.views[i] for i in some))
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
    views: BoardViews,
    lens: str,
    parameters: Float[np.ndarray, " 9"],
    chosen: Sequence[int] | None = None,
) -> Float[np.ndarray, "V 7"]:
    """(V, 7) T_camera_board of every view, found from that view alone; NaN where none is found.

    Corners become rays, and the rays are projected into a pinhole camera that looks at their
    middle, whatever its angle to the real axis. Of IPPE's two poses, that of lower error is taken.

    Args:
        chosen: the views, by number; all of them if not given.

    Source: Collins and Bartoli (2014), "Infinitesimal plane-based pose estimation", by OpenCV.
    """
    shown = [views.views[i] for i in range(len(views.views)) if chosen is None or i in set(chosen)]
    corners_px = lens_bundle.padded_corners(replace(views, views=tuple(shown))).corners_px
    rays = np.asarray(_rays(lens, jnp.asarray(parameters), jnp.asarray(corners_px)))
    return np.array(
        [
            pose_from_rays(views.points_board_m[view.ids], rays[row, view.ids])
            for row, view in enumerate(shown)
        ]
    ).reshape(-1, 7)


@partial(jax.jit, static_argnames="lens")
def _rays(lens: str, parameters: Array, corners_px: Array) -> Array:
    return lens_bundle.camera_of(lens, parameters).unproject(corners_px)


def pose_from_rays(
    points_board_m: Float[np.ndarray, "N 3"], rays_camera: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, " 7"]:
    """T_camera_board (7,) of a view from its points and their rays; NaN where none is found."""
    nowhere = np.full(7, np.nan)
    middle = rays_camera.mean(axis=0)
    if len(points_board_m) < _FEWEST or np.linalg.norm(middle) < 1e-3:
        return nowhere
    turn = Rotation.align_vectors([[0, 0, 1]], [middle / np.linalg.norm(middle)])[0]
    turned = turn.apply(rays_camera)
    image = turned[:, :2] / np.maximum(turned[:, 2:], 1e-9)
    near = np.linalg.norm(image, axis=1) < _WIDEST
    if near.sum() < _FEWEST:
        return nowhere
    centre_m = points_board_m[near].mean(axis=0)  # IPPE needs no centring, but is better for it
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            points_board_m[near] - centre_m, image[near], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # points on one line
        return nowhere
    if not rotations:
        return nowhere
    R = turn.inv() * Rotation.from_rotvec(rotations[0].ravel())
    t_m = turn.inv().apply(translations[0].ravel()) - R.apply(centre_m)
    pose = np.concatenate([np.roll(R.as_quat(), 1), t_m])
    return pose if np.all(np.isfinite(pose)) else nowhere


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
