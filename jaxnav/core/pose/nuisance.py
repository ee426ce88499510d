"""Errors that a pose is not asked for, eliminated from the residuals of one observation.

A camera is not quite where its rig says, a car rolls and pitches. Such an error t has a prior of
its own, and moves the residuals by J_t t. In its most probable value, for which its prior pays,

    min_t |r + J_t t|^2 + |t|^2 = r' (I + J_t J_t')^-1 r,

it takes from the residuals what it explains as well as the pose does: a bearing that two cameras
can't share turns a camera by its sigma, not the vehicle by twenty degrees.

Source: Mikhail (1976), "Observations and least squares", section 7 (elimination); Golub,
Van Loan (2013), section 2.1.4 (Woodbury).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.linalg.small_matrices import cholesky, log_det, product, solve_positive
from jaxnav.core.models.geometry import safe_norm, skew, transform_points
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.linearised import answers, reprojection_rows
from jaxnav.core.pose.observation import Sightings, cameras_of


class Nuisance(eqx.Module):
    """Directions t of g independent groups in which residuals (m, N) of N poses may be moved."""

    slopes: Float[Array, "t m g N"]  # J_t, in units of the prior's sigma
    gains: Float[Array, "t m g N"]  # (I + J_t' J_t)^-1 J_t'
    log_share: Float[Array, " N"]  # -log |I + J_t' J_t| / 2, what the residuals leave of the prior

    @staticmethod
    def of(slopes: Float[Array, "t m g N"]) -> "Nuisance":
        """The nuisance of these slopes. Groups must not move the same residual."""
        t, _, groups, lanes = slopes.shape
        eye = jnp.eye(t, dtype=slopes.dtype)[:, :, None, None]
        information = jnp.sum(slopes[:, None] * slopes[None], axis=2) + eye
        gains = solve_positive(information[:, :, None], slopes)
        factors = jax.vmap(cholesky, in_axes=-1)(information.reshape(t, t, groups * lanes))
        log_dets = jax.vmap(log_det)(factors).reshape(groups, lanes)
        return Nuisance(slopes, gains, -jnp.sum(log_dets, axis=0) / 2)

    def at_best(self, residuals: Float[Array, "m N"]) -> Float[Array, "t g N"]:
        """The most probable error."""
        return -jnp.sum(self.gains * residuals[None, :, None], axis=1)

    def eliminated(self, rows: Float[Array, "*n m N"]) -> Float[Array, "*n rows N"]:
        """Residuals, or derivatives of them: moved, and the prior's own rows below."""
        if rows.ndim == 3:
            return jax.vmap(self.eliminated)(rows)
        best = self.at_best(rows)
        moved = rows + jnp.sum(best[:, None] * self.slopes, axis=(0, 2))
        return jnp.concatenate([moved, best.reshape(-1, rows.shape[-1])])


class CameraSlopes(eqx.Module):
    """How the errors of the g cameras in view move the residuals of an observation."""

    places: Float[Array, "3 m g"]  # by a shift, in units of the prior's sigma
    turns: Float[Array, "3 m g"]  # by a turn, in units of the prior's sigma
    camera: Int[Array, " g"]  # index of each group's camera
    in_view: Bool[Array, " g"]  # False: the group is empty

    def nuisance(self) -> Nuisance:
        """Both, new in every frame, with a single lane for all poses."""
        return Nuisance.of(jnp.concatenate([self.places, self.turns])[..., None])


def camera_errors(rig: CameraRig, markers: MarkerMap, seen: Sightings) -> Nuisance | None:
    """The cameras' errors in place and direction, with the prior of `rig.extrinsics_sigma`.

    None where the cameras are exact. The nuisance has a single lane, for all poses.
    """
    moves = camera_slopes(rig, markers, seen)
    return None if moves is None else moves.nuisance()


def camera_slopes(rig: CameraRig, markers: MarkerMap, seen: Sightings) -> CameraSlopes | None:
    """The derivatives of the residuals by each camera's error; None where the cameras are exact.

    Each camera is a group, or each sighting where these are fewer. The derivatives are those at the
    corners as seen, at a distance that their sides tell: so every pose of an observation is
    compared with the same errors.

    Args:
        rig: C cameras.
        markers: M markers.
        seen: D sightings, of m = 8 D residuals.
    """
    if rig.extrinsics_sigma is None:
        return None
    D, C = seen.camera_index.shape[0], len(rig)
    of_slot, camera_of_group = seen.camera_index, jnp.arange(C)
    if D < C:  # a group is named by the first sighting of its camera
        of_slot = jnp.argmax(seen.camera_index[None] == seen.camera_index[:, None], axis=1)
        camera_of_group = seen.camera_index
    member = jnp.repeat(of_slot, 4)[:, None] == jnp.arange(min(C, D))[None]  # (P, g)
    positions = rig.Ts_camera_vehicle.inverse().translation()
    spread = jax.vmap(_twists_of_vehicle)(positions, rig.extrinsics_sigma)[camera_of_group]

    points = _points_as_seen(rig, markers, seen)
    _, slope = reprojection_rows(rig, seen)(points)
    moves = answers(slope, points)[..., 0]  # (6, 2 P)
    in_sigmas = jnp.sum(moves[:, None, :, None] * spread.transpose(1, 2, 0)[:, :, None], axis=0)
    slopes = jnp.where(jnp.tile(member, (2, 1))[None], in_sigmas, 0)
    in_view = jnp.any(member & jnp.repeat(seen.visible, 4)[:, None], axis=0)
    return CameraSlopes(slopes[:3], slopes[3:], camera_of_group, in_view)


def _points_as_seen(rig: CameraRig, markers: MarkerMap, seen: Sightings) -> Float[Array, "3 P 1"]:
    """Corners in the vehicle frame, m, on their rays, as far as the longest side tells."""

    def one(T_camera_vehicle: jaxlie.SE3, rays: Array, size_m: Array) -> Array:
        sides = safe_norm(rays - jnp.roll(rays, 1, axis=0))
        range_m = size_m / jnp.maximum(jnp.max(sides), 1e-3)
        return transform_points(T_camera_vehicle.inverse(), rays * range_m)

    sizes_m = markers.size_m[seen.marker_index]
    points = jax.vmap(one)(cameras_of(rig, seen)[1], seen.rays, sizes_m)
    return points.reshape(-1, 3).T[..., None]


def _twists_of_vehicle(
    position_m: Float[Array, " 3"], sigma: Float[Array, " 6"]
) -> Float[Array, "6 6"]:
    """Columns: twists about the vehicle's origin that shift and turn a camera by its sigmas."""
    eye = jnp.eye(3, dtype=position_m.dtype)
    to_origin = jnp.block([[eye, skew(position_m)], [jnp.zeros_like(eye), eye]])
    return product(to_origin, jnp.diag(sigma))
