"""Measures of how well views of a board determine a lens, and of how well the lens fits them."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import stats
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.fit import LensFit

_CELLS_WIDE = 8
_RIM_POINTS = 9  # along each side of the image


def border_px(image_size_px: tuple[int, int]) -> Float[np.ndarray, "N 2"]:
    """(N, 2) pixels along the image's border."""
    w, h = np.array(image_size_px) - 1.0
    part = np.linspace(0, 1, _RIM_POINTS)
    return np.concatenate([[[w * p, 0], [w * p, h], [0, h * p], [w, h * p]] for p in part])


def rim_sigma_px(fit: LensFit) -> float:
    """The largest standard deviation of a ray's projection at the image's border, px.

    It counts all but the centre and tangential coefficients: the camera's direction makes up for an
    error of the centre. It is infinite where the fitted lens doesn't reach the image's border.
    """
    pixels = border_px(fit.views.image_size_px)
    drawn_px, J = jax.device_get(
        _drawn_again(fit.lens, jnp.asarray(fit.parameters), jnp.asarray(pixels))
    )
    if np.max(np.abs(drawn_px - pixels)) > 1:
        return np.inf
    radial = np.array([name[0] not in "cp" for name in fit.names], float)
    J = J[..., : len(radial)] * radial
    covariance = fit.covariance[: len(radial), : len(radial)]
    squared = np.einsum("nci,ij,ncj->n", J, covariance, J)
    return float(np.sqrt(np.max(squared))) if np.all(np.isfinite(squared)) else np.inf


@partial(jax.jit, static_argnames="lens")
def _drawn_again(lens: str, parameters: Array, pixels: Array) -> tuple[Array, Array]:
    """Projections (N, 2) of the pixels' fixed rays, and their Jacobian (N, 2, 9) by the nine."""
    rays = lens_bundle.camera_of(lens, parameters).unproject(pixels)

    def drawn(parameters: Array) -> Array:
        return lens_bundle.camera_of(lens, parameters).project(rays)

    return drawn(parameters), jax.jacfwd(drawn)(parameters)


def reach(fit: LensFit) -> float:
    """Distance of the farthest corner seen from the image's middle, over that of its corner."""
    middle = (np.array(fit.views.image_size_px) - 1) / 2
    farthest = np.linalg.norm(_used_px(fit) - middle, axis=1).max(initial=0)
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
    """Coverage and mean residuals of the image in a grid of h x w cells.

    Attributes:
        corners: (h, w) number of corners of the fit in each cell.
        mean_px: (h, w, 2) their mean residual, 0 in empty cells.
        middle_px: (h, w, 2) the middle of each cell.
        systematic_px: RMS of the cells' means beyond their noise.
        p_value: of the cells' means if they were noise alone.
    """

    corners: Int[np.ndarray, "h w"]
    mean_px: Float[np.ndarray, "h w 2"]
    middle_px: Float[np.ndarray, "h w 2"]
    systematic_px: float
    p_value: float


def cells(fit: LensFit) -> Cells:
    """Compute coverage and mean residuals over the image."""
    width, height = fit.views.image_size_px
    wide, high = _CELLS_WIDE, max(2, round(_CELLS_WIDE * height / width))
    corners_px = _used_px(fit)
    column = np.clip((corners_px[:, 0] + 0.5) / width * wide, 0, wide - 1).astype(int)
    row = np.clip((corners_px[:, 1] + 0.5) / height * high, 0, high - 1).astype(int)
    weights = fit.weights[fit.used]
    counts, totals = np.zeros((high, wide)), np.zeros((high, wide))
    sums = np.zeros((high, wide, 2))
    np.add.at(counts, (row, column), 1)
    np.add.at(totals, (row, column), weights)
    np.add.at(sums, (row, column), weights[:, None] * fit.residual_px[fit.used])
    mean_px = sums / np.maximum(totals, 1e-12)[..., None]
    # A mean of total weight W has the variance sigma^2 / W in x and in y.
    filled = counts > 0
    squared = np.sum(mean_px[filled] ** 2, axis=-1)
    chance = 2 * fit.sigma_px**2 / totals[filled]
    statistic = float(np.sum(2 * squared / chance))
    x, y = np.meshgrid((np.arange(wide) + 0.5) / wide, (np.arange(high) + 0.5) / high)
    return Cells(
        corners=counts.astype(int),
        mean_px=mean_px,
        middle_px=np.stack([x * width - 0.5, y * height - 0.5], axis=-1),
        systematic_px=float(np.sqrt(max(np.mean(squared - chance), 0))),
        p_value=float(stats.chi2.sf(statistic, 2 * filled.sum())),
    )


def _used_px(fit: LensFit) -> np.ndarray:
    """(N, 2) the corners that are in the fit, px."""
    return np.asarray(lens_bundle.padded_corners(fit.views).corners_px[: len(fit.used)][fit.used])
