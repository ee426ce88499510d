"""Check of a calibration board's shape against its file, from the residuals of its corners."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import stats

from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.bundle import LensUnknowns
from jaxnav.calibrate.lens.fit import LensFit
from jaxnav.core.linalg.schur import reduce


@dataclass(frozen=True)
class BoardCheck:
    """The deviation of a board from what its file says.

    Attributes:
        stretch: part by which the board is taller for its width than its file says, with its sigma.
        offset_m: RMS distance of the points from where the file has them, beyond chance.
        p_value: of the offsets if they were noise alone.
    """

    stretch: float
    stretch_sigma: float
    offset_m: float
    p_value: float


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
    lens: str, y: LensUnknowns, seen: lens_bundle.BoardCorners, weights: Array
) -> tuple[Array, Array, Array]:
    """Derivatives (V, P, 2, 2) by a point's x and y; information (10, 10) and gradient (10,) of the
    lens and the board's stretch, with the poses eliminated."""
    residual_px, of_lens, of_pose = lens_bundle.linearised(lens, y, seen)
    of_point = of_pose[..., :2]  # a pose that shifts along the board's x and y
    stretch = of_point[..., 1:] * seen.points_board_m[None, :, None, 1:2]
    blocks = lens_bundle.normal_equations(
        residual_px,
        jnp.concatenate([of_lens, stretch], axis=-1),
        of_pose,
        jnp.sqrt(jnp.where(seen.present, weights, 0)),
    )
    reduced = reduce(blocks, jnp.ones(of_lens.shape[-1] + 1, bool), jnp.zeros(()))
    return of_point, reduced.system, reduced.gradient
