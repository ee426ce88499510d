"""How well views of a board determine a lens, what is wrong with its fit, and what to do next."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import stats
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.bundle import BoardCorners, LensUnknowns
from jaxnav.calibrate.lens.fit import LensFit
from jaxnav.calibrate.lens.maps import ray_slopes

_CELLS_WIDE = 8
_RIM_POINTS = 9  # along each side of the image
_CHANCE = 1e-6
_SYSTEMATIC = 0.3  # of the noise
_STRETCH, _OFFSET = 0.002, 3e-4  # of the board's height, and of its diagonal
_GOOD_RIM_PX, _GOOD_REACH = 0.5, 0.8  # of the way to the image's corner


def findings(fit: LensFit, better: str) -> tuple[str, ...]:
    """A line for everything that is wrong with the fit, or was held at zero.

    Args:
        better: the lens that explains unseen views clearly better, or else the fit's own lens.
    """
    lens, seen, draws_all = fit.lens, cells(fit), bool(np.isfinite(rim_sigma_px(fit)))
    lines = []
    if fit.fixed:
        lines.append(
            f"{', '.join(fit.fixed)} held at zero: corners reach {100 * reach(fit):.0f} % of the "
            "way to the image's corner"
        )
    if better != lens:
        lines.append(f"lens {better} explains unseen views clearly better: try --lens {better}")
    if not draws_all:
        lines.append(f"lens {lens} does not reach the image's border: try another --lens")
    if seen.p_value < _CHANCE and seen.systematic_px > _SYSTEMATIC * fit.sigma_px:
        lines.append(
            f"residuals are systematic, {seen.systematic_px:.2g} px beside {fit.sigma_px:.2g} px "
            "of noise: another lens, or a board that is not flat"
        )
    if better == lens and draws_all:  # a wrong lens looks like a wrong board
        board = check_board(fit)
        size_m = float(np.linalg.norm(np.ptp(fit.views.points_board_m, axis=0)))
        if abs(board.stretch) > max(_STRETCH, 5 * board.stretch_sigma):
            lines.append(
                f"the board is {100 * board.stretch:+.2g} % taller for its width than its file "
                "says: measure both sides"
            )
        if board.p_value < _CHANCE and board.offset_m > _OFFSET * size_m:
            lines.append(
                f"points of the board lie {1000 * board.offset_m:.2g} mm from where its file says: "
                "measure squares and gaps, and see that it is flat"
            )
    if unseen := _unseen_sides(fit):
        lines.append(
            f"no view shows the {' nor the '.join(unseen)} of the board's points: are there as "
            "many rows and columns as its file says?"
        )
    worse, count = int(np.sum(fit.view_weights < 1)), len(fit.view_weights)
    if worse > count / 3:
        lines.append(f"{worse} of {count} views fit worse: blur, or a board that bends")
    if not fit.converged:
        lines.append("the search was ended before it had settled")
    return tuple(lines)


def advice(fit: LensFit) -> tuple[str, ...]:
    """A line for everything to collect next: what to do, the number now, and a good one."""
    focal, center_px = 100 * float(np.max(fit.focal_sigma)), float(np.max(fit.sigma[2:4]))
    kept, (tilt_deg, _) = fit.view_weights > 0, tilts_deg(fit)
    distances_m = np.linalg.norm(fit.Ts_camera_board[kept, 4:], axis=1)
    ratio = distances_m.max() / distances_m.min()
    empty, rim_px = _empty_regions(fit), rim_sigma_px(fit)
    hidden = empty and (rim_px > _GOOD_RIM_PX or fit.fixed or reach(fit) < _GOOD_REACH)
    unsure = _GOOD_RIM_PX < rim_px < np.inf and not hidden
    views, tilted = int(kept.sum()), "tilt the board by 30 to 45 deg"
    lines = (
        (views < 15, f"take more views: {views}, 20 to 40 are good"),
        (focal > 0.1, f"{tilted}, fill the image: focal length to {focal:.2g} %, 0.1 % is good"),
        (center_px > 0.3, f"{tilted} to all sides: centre to {center_px:.2g} px, 0.3 px is good"),
        (tilt_deg < 15, f"{tilted}: less than {tilt_deg:.0f} deg in half of the views"),
        (ratio < 1.5, f"vary the distance: farthest over nearest is {ratio:.2g}, 2 is good"),
        (hidden, f"hold the board where no corner was seen: {', '.join(empty)} of the image"),
        (unsure, f"take more views at the border: known to {rim_px:.2g} px, 0.5 px is good"),
    )
    sure = f"nothing is missing: focal length to {focal:.2g} %, centre to {center_px:.2g} px"
    return tuple(line for missing, line in lines if missing) or (sure,)


def _unseen_sides(fit: LensFit) -> list[str]:
    """Names of the board's outer rows and columns of points that no view shows."""
    points_m, seen = fit.views.points_board_m[:, :2], np.any(fit.used, axis=0)
    near = np.abs(points_m[:, None] - [points_m.max(axis=0), points_m.min(axis=0)])
    on_side = near < 1e-3 * np.ptp(points_m, axis=0).max()  # (P, high or low, x or y)
    sides = {"top row": (0, 1), "bottom row": (1, 1), "left column": (1, 0), "right column": (0, 0)}
    return [name for name, (end, axis) in sides.items() if not np.any(seen[on_side[:, end, axis]])]


def _empty_regions(fit: LensFit) -> list[str]:
    """Names of those of the image's nine parts with no corner in a third or more of their cells."""
    empty = cells(fit).corners == 0
    row, column = (np.arange(n) * 3 // n for n in empty.shape)
    parts = {
        f"{high} {side}".strip(): empty[np.ix_(row == r, column == c)]
        for r, high in enumerate(("top", "middle", "bottom"))
        for c, side in enumerate(("left", "", "right"))
    }
    return [name for name, part in parts.items() if part.size and part.mean() >= 1 / 3]


def rim_sigma_px(fit: LensFit) -> float:
    """The largest standard deviation of a ray's projection at the image's border, px.

    It counts all but the centre and tangential coefficients: the camera's direction makes up for an
    error of the centre. It is infinite where the fitted lens doesn't reach the image's border.
    """
    w, h = np.array(fit.views.image_size_px) - 1.0
    part = np.linspace(0, 1, _RIM_POINTS)
    pixels = np.concatenate([[[w * p, 0], [w * p, h], [0, h * p], [w, h * p]] for p in part])
    J, _, drawn = jax.device_get(ray_slopes(fit.lens, fit.parameters, pixels))
    if not np.all(drawn):
        return np.inf
    radial = np.array([name[0] not in "cp" for name in fit.names], float)
    J = J[..., : len(radial)] * radial
    covariance = fit.covariance[: len(radial), : len(radial)]
    squared = np.einsum("nci,ij,ncj->n", J, covariance, J)
    return float(np.sqrt(np.max(squared))) if np.all(np.isfinite(squared)) else np.inf


def reach(fit: LensFit) -> float:
    """Distance of the farthest corner seen from the image's middle, over that of its corner."""
    middle = (np.array(fit.views.image_size_px) - 1) / 2
    farthest = np.linalg.norm(fit.used_px - middle, axis=1).max(initial=0)
    return float(farthest / np.linalg.norm(middle))


def tilts_deg(fit: LensFit) -> tuple[float, float]:
    """The median angle between the board's normal and the camera's axis; and the largest angle
    between the normals of two views, 0 if all views are parallel."""
    kept = fit.view_weights > 0
    quaternions = np.roll(fit.Ts_camera_board[kept, :4], -1, axis=1)
    normals_camera = Rotation.from_quat(quaternions).as_matrix()[:, :, 2]
    to_axis = np.rad2deg(np.arccos(np.clip(-normals_camera[:, 2], -1, 1)))
    between = np.rad2deg(np.arccos(np.clip(normals_camera @ normals_camera.T, -1, 1)))
    return float(np.median(to_axis)), float(between.max())


@dataclass(frozen=True)
class Cells:
    """Coverage and mean residuals of the image in a grid of h x w cells."""

    corners: Int[np.ndarray, "h w"]  # number of corners of the fit in each cell
    mean_px: Float[np.ndarray, "h w 2"]  # their mean residual, 0 in empty cells
    middle_px: Float[np.ndarray, "h w 2"]  # the middle of each cell
    systematic_px: float  # RMS of the cells' means beyond their noise
    p_value: float  # of the cells' means if they were noise alone


def cells(fit: LensFit) -> Cells:
    """Compute coverage and mean residuals over the image."""
    width, height = fit.views.image_size_px
    wide, high = _CELLS_WIDE, max(2, round(_CELLS_WIDE * height / width))
    at = (fit.used_px + 0.5) / [width, height] * [wide, high]
    column, row = np.clip(at, 0, [wide - 1, high - 1]).astype(int).T
    residuals = np.column_stack([np.ones(len(at)), fit.residual_px[fit.used]])
    sums = np.zeros((high, wide, 3))
    np.add.at(sums, (row, column), fit.weights[fit.used][:, None] * residuals)
    counts = np.histogram2d(row, column, (range(high + 1), range(wide + 1)))[0].astype(int)
    totals, mean_px = sums[..., 0], sums[..., 1:] / np.maximum(sums[..., :1], 1e-12)
    # A mean of total weight W has the variance sigma^2 / W in x and in y.
    filled = counts > 0
    squared = np.sum(mean_px[filled] ** 2, axis=-1)
    chance = 2 * fit.sigma_px**2 / totals[filled]
    statistic = float(np.sum(2 * squared / chance))
    x, y = np.meshgrid((np.arange(wide) + 0.5) / wide, (np.arange(high) + 0.5) / high)
    return Cells(
        corners=counts,
        mean_px=mean_px,
        middle_px=np.stack([x * width - 0.5, y * height - 0.5], axis=-1),
        systematic_px=float(np.sqrt(max(np.mean(squared - chance), 0))),
        p_value=float(stats.chi2.sf(statistic, 2 * filled.sum())),
    )


@dataclass(frozen=True)
class BoardCheck:
    """The deviation of a board from what its file says."""

    # part by which the board is taller for its width than its file says, with its sigma
    stretch: float
    stretch_sigma: float
    offset_m: float  # RMS distance of the points from where the file has them, beyond chance
    p_value: float  # of the offsets if they were noise alone


def check_board(fit: LensFit) -> BoardCheck:
    """Take one Gauss-Newton step with the board free to stretch, then with every point free.

    One camera can't see that a board is too large or too small as a whole: that scales the
    distances of all views and changes nothing else.
    """
    seen, y = lens_bundle.padded(fit.views, fit.parameters, fit.Ts_camera_board)
    count = len(fit.views.views)
    weights = np.zeros(seen.present.shape)
    weights[:count] = fit.weights
    free = lens_bundle.free_mask(fit.lens, fit.fixed)
    J, information, gradient = jax.device_get(
        _board_freedom(fit.lens, y, seen, jnp.asarray(weights))
    )
    kept = np.append(free, True)
    scale = 1 / np.sqrt(np.maximum(np.diag(information)[kept], 1e-300))
    scaled = information[np.ix_(kept, kept)] * np.outer(scale, scale)
    inverse = np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) * np.outer(scale, scale)
    residual_px = np.zeros((*weights.shape, 2))
    residual_px[:count] = fit.residual_px

    # (P, 2, 2) and (P, 2): normal equations of each point's place on the board, from all views.
    H = np.einsum("vp,vpci,vpcj->pij", weights, J, J)
    g = np.einsum("vp,vpci,vpc->pi", weights, J, residual_px)
    often = (weights > 0).sum(axis=0) >= 2
    offsets = -np.linalg.solve(H[often], g[often][..., None])[..., 0]
    chance = fit.sigma_px**2 * np.linalg.inv(H[often])
    statistic = np.einsum("pi,pij,pj->", offsets, H[often], offsets) / fit.sigma_px**2
    beyond = np.sum(offsets**2, axis=1) - np.trace(chance, axis1=1, axis2=2)
    return BoardCheck(
        stretch=float(-(inverse @ gradient[kept])[-1]),
        stretch_sigma=float(fit.sigma_px * np.sqrt(max(inverse[-1, -1], 0))),
        offset_m=float(np.sqrt(max(np.mean(beyond), 0))) if often.any() else 0.0,
        p_value=float(stats.chi2.sf(statistic, 2 * often.sum())),
    )


@partial(jax.jit, static_argnames="lens")
def _board_freedom(
    lens: str, y: LensUnknowns, seen: BoardCorners, weights: Array
) -> tuple[Array, Array, Array]:
    """Derivatives (V, P, 2, 2) by a point's x and y; information (10, 10) and gradient (10,) of the
    lens and the board's stretch, with the poses eliminated."""
    residual_px, of_lens, of_pose = lens_bundle.linearised(lens, y, seen)
    of_point = of_pose[..., :2]  # a pose that shifts along the board's x and y
    stretch = of_point[..., 1:] * seen.points_board_m[None, :, None, 1:2]
    shared = jnp.concatenate([of_lens, stretch], axis=-1)
    information, gradient = lens_bundle.without_poses(residual_px, shared, of_pose, weights)
    return of_point, jnp.sum(information, axis=0), jnp.sum(gradient, axis=0)
