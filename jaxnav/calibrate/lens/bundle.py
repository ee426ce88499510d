"""Bundle adjustment of one camera and all its views of a board.

The unknowns are the lens, nine numbers that all views share, and the pose of the board in every
view. The poses are eliminated (`calibrate.schur`), so time and memory grow linearly with the
number of views. The frame is the board's, so there is no gauge to fix.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Shaped

from jaxnav.calibrate.board.views import BoardViews
from jaxnav.calibrate.schur import Blocks, SchurLM
from jaxnav.core.linalg.levenberg_marquardt import LMState
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import cayley, rotation_matrix, skew, turn_and_shift
from jaxnav.core.models.lenses import LENSES, MOST_COEFFICIENTS

# Names of the shared unknowns, in order; unknowns that a lens doesn't have are fixed at zero.
FITTED = ("none", "radtan", "equidistant", "omni", "double_sphere", "eucm")
TRIED = ("none", "radtan", "equidistant")  # where nobody asks for one: each costs a fit
NAMES = {lens: ("fx", "fy", "cx", "cy", *LENSES[lens].coefficients) for lens in FITTED}
COUNT = 9
_ABOVE_ZERO = dict.fromkeys(("fx", "fy"), (0.0, np.inf))
_BOUNDS = {lens: _ABOVE_ZERO | dict(LENSES[lens].within) for lens in FITTED}
NO_CUT = 1e8  # in sigmas: plain least squares
_BATCH = 16  # views are padded to a multiple of this, so that few sizes are compiled


class BoardCorners(eqx.Module):
    """The observed corners, padded: V views of P points. They stay on the host until solved."""

    points_board_m: Float[Array | np.ndarray, "P 3"]
    corners_px: Float[Array | np.ndarray, "V P 2"]
    present: Bool[Array | np.ndarray, "V P"]


class LensUnknowns(eqx.Module):
    """The unknowns of the problem: the lens and the pose of the board in every view."""

    lens: Float[Array, " 9"]  # fx fy cx cy, then the coefficients as the camera counts them
    Ts_camera_board: Float[Array, "V 7"]  # wxyz_xyz


class Bundle(eqx.Module):
    """The solution of the least-squares problem: a minimum with its normal equations."""

    unknowns: LensUnknowns
    residual_px: Float[Array, "V P 2"]  # predicted - seen; 0 for points not seen
    converged: Bool[Array, ""]


def free_mask(lens: str, fixed: tuple[str, ...] = ()) -> Bool[np.ndarray, " 9"]:
    """(9,) bool: true for shared unknowns that the fit may change."""
    names = NAMES[lens]
    return np.array([i < len(names) and names[i] not in fixed for i in range(COUNT)])


def camera_of(lens: str, parameters: Float[Array, " 9"]) -> Camera:
    """The camera with these nine parameters."""
    coefficients = jnp.pad(parameters[4:], (0, MOST_COEFFICIENTS + 4 - COUNT))
    return Camera(parameters[:2], parameters[2:4], coefficients, jnp.asarray(0), (lens,))


@jax.vmap
def retracted(wxyz_xyz: Float[Array, " 7"], xi: Float[Array, " 6"]) -> Float[Array, " 7"]:
    """Move poses (n, 7) by twists (n, 6): T * cay(xi)."""
    return (jaxlie.SE3(wxyz_xyz) @ cayley(xi)).normalize().wxyz_xyz


@partial(jax.jit, static_argnames="lens")
def axis_px(lens: str, parameters: Float[Array, " 9"]) -> tuple[Float[Array, " 2"], Array]:
    """`Camera.axis_px`, and its derivatives (2, 9) by the nine.

    Of a lens with xi, views determine fx and fy much worse: that coefficient makes up for them.
    """

    def on_axis(parameters: Array) -> Array:
        return camera_of(lens, parameters).axis_px

    return on_axis(parameters), jax.jacfwd(on_axis)(parameters)


def padded_corners(views: BoardViews) -> BoardCorners:
    """The views as arrays on the host, padded with empty views."""
    rows = -(-len(views.views) // _BATCH) * _BATCH
    points = len(views.points_board_m)
    corners_px, present = np.zeros((rows, points, 2)), np.zeros((rows, points), bool)
    for row, view in enumerate(views.views):
        corners_px[row, view.ids] = view.corners_px
        present[row, view.ids] = True
    return BoardCorners(np.asarray(views.points_board_m, float), corners_px, present)


def padded(
    views: BoardViews,
    parameters: Float[np.ndarray, " 9"],
    Ts_camera_board: Float[np.ndarray, "V 7"],
) -> tuple[BoardCorners, LensUnknowns]:
    """The views, and unknowns to start from, padded with empty views.

    Args:
        parameters: (9,) of the lens.
        Ts_camera_board: (V, 7); a view whose pose is NaN faces the board from 1 m away.
    """
    seen = padded_corners(views)
    poses = np.tile([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(seen.corners_px), 1))
    known = np.flatnonzero(~np.isnan(Ts_camera_board[:, 0]))
    poses[known] = Ts_camera_board[known]
    return seen, LensUnknowns(jnp.asarray(parameters), jnp.asarray(poses))


@partial(jax.jit, static_argnames="lens")
def solve(
    lens: str,
    start: LensUnknowns,
    seen: BoardCorners,
    weights: Shaped[Array | np.ndarray, "V P"],
    free: Bool[Array | np.ndarray, " 9"],
    sigma_px: float | Float[Array, ""] = 1.0,
    cut: float | Float[Array, ""] = NO_CUT,
) -> Bundle:
    """Find the unknowns that explain the corners best.

    A corner at the distance d from its prediction, in sigmas, costs cut^2 log(1 + d^2 / cut^2)
    (Cauchy): nearly d^2 close to 0, and a logarithm of d beyond the cut.

    Args:
        weights: factors of each corner's squared distance; 0 leaves a corner out.
        free: mask of the nine shared unknowns that move.
        cut: in sigmas; `NO_CUT` for plain least squares.
    """
    scale = jnp.sqrt(jnp.where(seen.present, weights, 0.0)) / sigma_px
    free = jnp.asarray(free)

    def fn(y: LensUnknowns, args: Any) -> Any:
        residual_px, of_lens, of_pose = linearised(lens, y, seen)
        squared = jnp.sum(residual_px**2, axis=-1) * scale**2
        cost = cut**2 * jnp.log1p(squared / cut**2)
        counts = scale / jnp.sqrt(1 + squared / cut**2)
        return jnp.sqrt(cost).reshape(-1), _normal_equations(residual_px, of_lens, of_pose, counts)

    solution: optx.Solution = optx.least_squares(
        fn,
        SchurLM(
            rtol=1e-12, atol=1e-12, norm=optx.max_norm, retract=partial(_moved, lens), free=free
        ),
        start,
        has_aux=True,
        max_steps=100,
        throw=False,
    )
    state: LMState = solution.state
    return Bundle(
        unknowns=solution.value,
        residual_px=residuals_px(lens, solution.value, seen),
        converged=state.done,
    )


@partial(jax.jit, static_argnames="lens")
def view_information(
    lens: str, y: LensUnknowns, seen: BoardCorners, weights: Float[Array, "V P"]
) -> tuple[Float[Array, "V 9 9"], Float[Array, "V 9"]]:
    """Information of the nine from each view alone, its pose eliminated, for 1 px of noise.

    Also the gradient of half the cost of each view by the nine.
    """
    return without_poses(*linearised(lens, y, seen), jnp.where(seen.present, weights, 0))


def without_poses(
    residual_px: Float[Array, "V P 2"],
    of_shared: Float[Array, "V P 2 R"],
    of_pose: Float[Array, "V P 2 6"],
    weights: Float[Array, "V P"],
) -> tuple[Float[Array, "V R R"], Float[Array, "V R"]]:
    """Information of shared unknowns from each view and gradient, its pose eliminated."""
    root = jnp.sqrt(weights)[..., None, None]
    # (V, 2P, R), (V, 2P, 6)
    A, B = ((root * J).reshape(J.shape[0], -1, J.shape[-1]) for J in (of_shared, of_pose))
    r = (root[..., 0] * residual_px).reshape(A.shape[0], -1, 1)
    length = jnp.sqrt(jnp.sum(B**2, axis=1, keepdims=True))
    Q, _ = jnp.linalg.qr(B / jnp.where(length > 0, length, 1))
    rest = A - Q @ (jnp.swapaxes(Q, 1, 2) @ A)
    transposed = jnp.swapaxes(rest, 1, 2)
    return transposed @ rest, (transposed @ r)[..., 0]


@partial(jax.jit, static_argnames="lens")
def residuals_px(lens: str, y: LensUnknowns, seen: BoardCorners) -> Float[Array, "V P 2"]:
    """Residuals, predicted - seen; 0 for points not seen."""
    camera = camera_of(lens, y.lens)

    def view(wxyz_xyz: Array) -> Array:
        T_camera_board = jaxlie.SE3(wxyz_xyz)
        R_camera_board = rotation_matrix(T_camera_board.rotation())
        t_m = T_camera_board.translation()
        return camera.project(turn_and_shift(R_camera_board, t_m, jnp.asarray(seen.points_board_m)))

    residual_px = jax.vmap(view)(y.Ts_camera_board) - seen.corners_px
    return jnp.where(seen.present[..., None], residual_px, 0)


def linearised(
    lens: str, y: LensUnknowns, seen: BoardCorners
) -> tuple[Float[Array, "V P 2"], Float[Array, "V P 2 9"], Float[Array, "V P 2 6"]]:
    """Residuals (V, P, 2), their Jacobians by the nine (V, P, 2, 9) and by xi (V, P, 2, 6)."""

    def pixel(parameters: Array, point_camera: Array) -> tuple[Array, Array]:
        projected = camera_of(lens, parameters).project(point_camera)
        return projected, projected

    def corner(R_camera_board: Array, t_m: Array, point_board: Array) -> tuple[Array, ...]:
        point_camera = R_camera_board @ point_board + t_m
        (of_lens, of_point), projected = jax.jacfwd(pixel, argnums=(0, 1), has_aux=True)(
            y.lens, point_camera
        )
        by_xi = jnp.concatenate([R_camera_board, -R_camera_board @ skew(point_board)], axis=1)
        return projected, of_lens, of_point @ by_xi

    def view(wxyz_xyz: Array) -> tuple[Array, ...]:
        T_camera_board = jaxlie.SE3(wxyz_xyz)
        R_camera_board = rotation_matrix(T_camera_board.rotation())
        t_m = T_camera_board.translation()
        return jax.vmap(partial(corner, R_camera_board, t_m))(jnp.asarray(seen.points_board_m))

    projected, of_lens, of_pose = jax.vmap(view)(y.Ts_camera_board)
    return projected - seen.corners_px, of_lens, of_pose


def _normal_equations(
    residual_px: Float[Array, "V P 2"],
    of_lens: Float[Array, "V P 2 R"],
    of_pose: Float[Array, "V P 2 6"],
    counts: Float[Array, "V P"],
) -> Blocks:
    """Normal equations of the residuals, each multiplied by its factor in `counts` (V, P)."""
    views = residual_px.shape[0]
    r = (counts[..., None] * residual_px).reshape(views, -1)
    A, B = (
        (counts[..., None, None] * J).reshape(views, -1, J.shape[-1]) for J in (of_lens, of_pose)
    )
    flat = A.reshape(-1, A.shape[-1])
    B_transposed = jnp.swapaxes(B, 1, 2)
    return Blocks(
        own=B_transposed @ B,
        cross=B_transposed @ A,
        shared=flat.T @ flat,
        own_gradient=(B_transposed @ r[..., None])[..., 0],
        shared_gradient=flat.T @ r.reshape(-1),
    )


def _moved(lens: str, y: LensUnknowns, own: Array, shared: Array) -> LensUnknowns:
    # A negative focal length would mirror the image, and formulas have bounds: a step goes at most
    # half the way to one.
    anywhere = -np.inf, np.inf
    bounds = [_BOUNDS[lens].get(name, anywhere) for name in NAMES[lens]]
    bounds += [anywhere] * (COUNT - len(bounds))
    least, most = jnp.asarray(bounds, y.lens.dtype).T
    moved = jnp.clip(y.lens + shared, (y.lens + least) / 2, (y.lens + most) / 2)
    return LensUnknowns(moved, retracted(y.Ts_camera_board, own))
