"""Bundle adjustment of a moving rig: the poses of all frames, of the cameras and of the markers."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int
from scipy import stats

from jaxnav.calibrate.lens.bundle import retracted
from jaxnav.calibrate.rig.views import RigViews
from jaxnav.calibrate.robust import sighting_cost, sighting_weight
from jaxnav.calibrate.schur import Blocks, ReducedSystem, SchurLM, reduce
from jaxnav.core.linalg.small_matrices import cho_solve, cholesky, solve_upper
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import rotation_matrix, skew
from jaxnav.core.models.rig import CameraRig

# The search ends when a step promises less than this of the cost, which is 1 a coordinate: every
# unknown is within a few hundredths of its sigma then.
_SETTLED = 1e-3
# The scale is taken from this quantile, so a fourth of all sightings may be wrong.
_QUANTILE = 0.75

MOVING = 8  # coefficients of a lens that move; a thin prism's stay as given


class RigUnknowns(eqx.Module):
    """Poses, each wxyz_xyz and moved from the right, T * cay(xi); and lenses, if they move.

    All frames share S groups of six unknowns: the twists of C cameras and of M markers; then, if
    lenses move, focal length, centre and first two coefficients of every camera, and after these
    every camera's other six coefficients.
    """

    Ts_world_vehicle: Float[Array, "F 7"]
    Ts_vehicle_camera: Float[Array, "C 7"]
    Ts_world_marker: Float[Array, "M 7"]
    lenses: Float[Array, "L 12"]  # fx fy cx cy and the first eight coefficients; L = C or 0

    @property
    def sixes(self) -> int:
        """S, the number of groups of six shared unknowns."""
        placed = self.Ts_vehicle_camera.shape[0] + self.Ts_world_marker.shape[0]
        return placed + 2 * self.lenses.shape[0]


def lenses_of(cameras: Camera) -> Float[Array, "*C 12"]:
    """The parameters of the cameras' lenses as unknowns."""
    moving = [cameras.focal_px, cameras.center_px, cameras.distortion[..., :MOVING]]
    return jnp.concatenate(moving, axis=-1)


def with_lenses(cameras: Camera, lenses: Float[Array, "*C 12"]) -> Camera:
    """The cameras with these lens parameters; any further coefficients stay."""
    focal_px, center_px, moving = jnp.split(lenses, [2, 4], axis=-1)
    distortion = jnp.concatenate([moving, cameras.distortion[..., MOVING:]], axis=-1)
    return Camera(focal_px, center_px, distortion, cameras.lens_index, cameras.lenses)


class RigSightings(eqx.Module):
    """The N sightings and the known sizes, lenses and noise."""

    frame: Int[Array, " N"]
    camera: Int[Array, " N"]
    marker: Int[Array, " N"]
    corners_px: Float[Array, "N 4 2"]
    corners_marker_m: Float[Array, "N 4 3"]
    cameras: Camera
    sigma_px: Float[Array, ""]


def seen(rig: CameraRig, views: RigViews, sigma_px: float) -> RigSightings:
    """Convert the views for the solver, in the process's precision."""
    return RigSightings(
        frame=jnp.asarray(views.frame),
        camera=jnp.asarray(views.camera),
        marker=jnp.asarray(views.marker),
        corners_px=jnp.asarray(views.corners_px),
        corners_marker_m=jnp.asarray(views.corners_marker_m()),
        cameras=rig.cameras,
        sigma_px=jnp.asarray(sigma_px, float),
    )


class Adjusted(eqx.Module):
    """The result of a bundle adjustment."""

    poses: RigUnknowns
    residuals_px: Float[Array, "N 4 2"]  # projected minus observed
    weight: Float[Array, " N"]  # of each sighting; 1 if it counts in full
    reduced: ReducedSystem  # of the weighted problem, undamped
    scores: Float[Array, "B R"]  # of every part of the recording, see `_scores`
    frames_follow: Float[Array, "F 6 R"]  # derivatives of the frames' twists by the shared unknowns
    converged: Bool[Array, ""]


@partial(jax.jit, static_argnames=("parts", "max_steps"))
def adjust(
    start: RigUnknowns,
    known: RigSightings,
    free: Bool[Array, " R"],
    parts: int = 1,
    max_steps: int = 60,
) -> Adjusted:
    """Find the most likely poses near a start.

    Args:
        free: (6 S,), mask of the shared unknowns that move. Fixed are the gauge, at least one
            camera and one marker, and whatever is known already.
        parts: B, the number of parts of the recording to compute scores for.
    """
    solver = SchurLM(rtol=0.0, atol=_SETTLED, norm=optx.max_norm, retract=moved, free=free)
    fn: Any = residuals_and_blocks
    solution: optx.Solution = optx.least_squares(
        fn, solver, start, known, has_aux=True, max_steps=max_steps, throw=False
    )
    residuals = reprojection_residuals_px(solution.value, known)
    reduced = reduce(solution.state.normal, free, jnp.zeros(()))
    return Adjusted(
        poses=solution.value,
        residuals_px=residuals,
        weight=sighting_weight(_chi2(residuals, known)),
        reduced=reduced,
        scores=_scores(solution.value, known, solution.state.normal, parts),
        frames_follow=-jax.vmap(solve_upper)(reduced.factor, reduced.carried),
        converged=jnp.asarray(solution.result == optx.RESULTS.successful),
    )


def moved(poses: RigUnknowns, own: Float[Array, "F 6"], shared: Float[Array, " R"]) -> RigUnknowns:
    """The unknowns after a move of the frames' twists and of the shared unknowns."""
    counts = [part.shape[0] for part in (poses.Ts_vehicle_camera, poses.Ts_world_marker)]
    ends = np.cumsum([*counts, poses.lenses.shape[0]])
    cameras, markers, lenses, others = jnp.split(shared.reshape(-1, 6), ends)

    return RigUnknowns(
        retracted(poses.Ts_world_vehicle, own),
        retracted(poses.Ts_vehicle_camera, cameras),
        retracted(poses.Ts_world_marker, markers),
        poses.lenses + jnp.concatenate([lenses, others], axis=1),
    )


@jax.jit
def reprojection_residuals_px(poses: RigUnknowns, known: RigSightings) -> Float[Array, "N 4 2"]:
    """Residuals of the corners, projected minus observed."""
    return _looked_at(poses, known)[0]


@jax.jit
def costs(poses: RigUnknowns, known: RigSightings) -> Float[Array, " N"]:
    """The cost of every sighting."""
    return sighting_cost(_chi2(_looked_at(poses, known)[0], known))


def residuals_and_blocks(
    poses: RigUnknowns, known: RigSightings
) -> tuple[Float[Array, " N"], Blocks]:
    """Square roots of the sightings' costs, and the normal equations at their weights."""
    loss, r, J_frame, J_shared = _linearised(poses, known)
    F, slots = poses.Ts_world_vehicle.shape[0], _slots(poses, known)
    S = poses.sixes

    def of_frames(rows: Array) -> Array:
        return jnp.zeros((F, *rows.shape[1:]), rows.dtype).at[known.frame].add(rows)

    crosses = jnp.einsum("nki,nskj->nsij", J_frame, J_shared)
    squares = jnp.einsum("nski,ntkj->nstij", J_shared, J_shared)
    cross = jnp.zeros((F, S, 6, 6), r.dtype).at[known.frame[:, None], slots].add(crosses)
    shared = jnp.zeros((S, S, 6, 6), r.dtype)
    shared = shared.at[slots[:, :, None], slots[:, None]].add(squares)
    gradient = jnp.zeros((S, 6), r.dtype).at[slots].add(jnp.einsum("nski,nk->nsi", J_shared, r))
    return jnp.sqrt(loss), Blocks(
        own=of_frames(jnp.einsum("nki,nkj->nij", J_frame, J_frame)),
        cross=cross.transpose(0, 2, 1, 3).reshape(F, 6, 6 * S),
        shared=shared.transpose(0, 2, 1, 3).reshape(6 * S, 6 * S),
        own_gradient=of_frames(jnp.einsum("nki,nk->ni", J_frame, r)),
        shared_gradient=gradient.reshape(6 * S),
    )


def _scores(
    poses: RigUnknowns, known: RigSightings, blocks: Blocks, parts: int
) -> Float[Array, "B R"]:
    """The contribution of each part of the recording, all equally long, to the gradient of the
    shared unknowns, with the frames' poses eliminated. At a minimum they add up to zero."""
    _, r, J_frame, J_shared = _linearised(poses, known)
    step = jax.vmap(lambda A, g: cho_solve(cholesky(A), g))(blocks.own, blocks.own_gradient)
    # Each residual after its frame has moved to its own minimum.
    left = r - jnp.einsum("nki,ni->nk", J_frame, step[known.frame])
    part = known.frame * parts // poses.Ts_world_vehicle.shape[0]
    slots = _slots(poses, known)
    S = poses.sixes
    rows = jnp.einsum("nski,nk->nsi", J_shared, left)
    zero = jnp.zeros((parts, S, 6), r.dtype)
    return zero.at[part[:, None], slots].add(rows).reshape(parts, 6 * S)


def _slots(poses: RigUnknowns, known: RigSightings) -> Int[Array, "N K"]:
    """Indices of the groups of six shared unknowns that each sighting depends on."""
    C, M = poses.Ts_vehicle_camera.shape[0], poses.Ts_world_marker.shape[0]
    slots = [known.camera, C + known.marker]
    if poses.lenses.shape[0]:
        slots += [C + M + known.camera, 2 * C + M + known.camera]
    return jnp.stack(slots, axis=1)


def _linearised(poses: RigUnknowns, known: RigSightings) -> tuple[Array, Array, Array, Array]:
    """Costs of the sightings (N,); residuals (N, 8), times the root of their weight; and their
    Jacobians by the frame's twist (N, 8, 6) and by the shared sixes (N, K, 8, 6)."""
    residuals, points, (slopes, lens_slopes), Rs = _looked_at(poses, known)
    in_camera, in_vehicle = points
    R_camera_vehicle, R_camera_marker = Rs
    N = residuals.shape[0]
    chi2 = _chi2(residuals, known)
    scale = jnp.sqrt(sighting_weight(chi2)) / known.sigma_px
    D = slopes * scale[:, None, None, None]  # (N, 4, 2, 3) per m in the camera

    def twist(D: Array, points: Array) -> Array:
        """Jacobian of the residuals by a shift and a turn of points (N, 4, 3)."""
        crosses = jax.vmap(jax.vmap(skew))(points)
        return jnp.concatenate([D, -D @ crosses], axis=-1).reshape(N, 8, 6)

    # T * cay(xi) moves a marker's points by xi, and those seen from a vehicle or camera by -xi.
    J_camera = -twist(D, in_camera)
    J_frame = -twist(D @ R_camera_vehicle[:, None], in_vehicle)
    J_marker = twist(D @ R_camera_marker[:, None], known.corners_marker_m)
    r = (residuals * scale[:, None, None]).reshape(N, 8)
    shared = [J_camera, J_marker]
    if poses.lenses.shape[0]:
        J_lens = lens_slopes.reshape(N, 8, 12) * scale[:, None, None]
        shared += [J_lens[..., :6], J_lens[..., 6:]]
    return sighting_cost(chi2), r, J_frame, jnp.stack(shared, axis=1)


def _looked_at(
    poses: RigUnknowns, known: RigSightings
) -> tuple[Array, tuple[Array, Array], tuple[Array, Array], tuple[Array, Array]]:
    """Residuals in px; corners in camera and vehicle; d px / d m in the camera and d px / d lens;
    rotations from vehicle and marker to the camera."""

    def split(wxyz_xyz: Array) -> tuple[Array, Array]:
        return jax.vmap(lambda T: rotation_matrix(jaxlie.SO3(T[:4])))(wxyz_xyz), wxyz_xyz[:, 4:]

    R_wv, t_wv = (part[known.frame] for part in split(poses.Ts_world_vehicle))
    R_vc, t_vc = (part[known.camera] for part in split(poses.Ts_vehicle_camera))
    R_wm, t_wm = (part[known.marker] for part in split(poses.Ts_world_marker))
    in_world = known.corners_marker_m @ jnp.swapaxes(R_wm, 1, 2) + t_wm[:, None]
    in_vehicle = (in_world - t_wv[:, None]) @ R_wv
    in_camera = (in_vehicle - t_vc[:, None]) @ R_vc
    lenses_move = poses.lenses.shape[0] > 0
    cameras = with_lenses(known.cameras, poses.lenses) if lenses_move else known.cameras
    cameras = jax.tree.map(lambda leaf: leaf[known.camera], cameras)

    def pixel(camera: Camera, point: Array) -> tuple[Array, Array, Array]:
        px, by_point = camera.project_with_slope(point)
        if not lenses_move:
            return px, by_point, jnp.zeros((2, 0), px.dtype)
        by_lens = jax.jacfwd(lambda lens: with_lenses(camera, lens).project(point))
        return px, by_point, by_lens(lenses_of(camera))

    px, *slopes = jax.vmap(jax.vmap(pixel, in_axes=(None, 0)))(cameras, in_camera)
    R_cv = jnp.swapaxes(R_vc, 1, 2)
    R_cm = R_cv @ jnp.swapaxes(R_wv, 1, 2) @ R_wm
    residuals = px - known.corners_px
    return residuals, (in_camera, in_vehicle), (slopes[0], slopes[1]), (R_cv, R_cm)


def _chi2(residuals: Float[Array, "N 4 2"], known: RigSightings) -> Float[Array, " N"]:
    return jnp.sum(residuals**2, axis=(1, 2)) / known.sigma_px**2


def sigma_px_of(residuals_px: Float[np.ndarray, "N 4 2"]) -> float:
    """Standard deviation of a corner's coordinate; up to a fourth of the sightings may be wrong."""
    distance2 = np.sum(residuals_px**2, axis=(1, 2))
    return float(np.sqrt(np.quantile(distance2, _QUANTILE) / stats.chi2.ppf(_QUANTILE, 8)))
