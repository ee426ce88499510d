"""Residuals of corners and their derivatives, the paper's two errors, and nuisances eliminated.

A minimisation asks for residuals and derivatives at every step, and for so few unknowns closed form
is cheaper than differentiation. Coordinates come first, then corners, and the poses, which all are
treated alike, last: that is the axis that runs through vector registers. Sums of three or six
products are written as sums over an axis, which XLA computes once and keeps; it would repeat a
chain of additions in every consumer of the result.

A nuisance is an error that a pose is not asked for. A camera is not quite where its rig says, a car
rolls and pitches. Such an error t has a prior of its own, and moves the residuals by J_t t. In its
most probable value, for which its prior pays,

    min_t |r + J_t t|^2 + |t|^2 = r' (I + J_t J_t')^-1 r,

it takes from the residuals what it explains as well as the pose does: a bearing that two cameras
can't share turns a camera by its sigma, not the vehicle by twenty degrees.

Source: Liu, Schofield, Shan (2023), Eqs. 3, 13 and 14; Mikhail (1976), "Observations and least
squares", section 7 (elimination); Golub, Van Loan (2013), section 2.1.4 (Woodbury).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.linalg.small_matrices import cholesky, log_det, product, solve_positive
from jaxnav.core.models.geometry import rotation_matrix, safe_norm, skew, transform_points
from jaxnav.core.models.lenses import MOST_COEFFICIENTS, image_of
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import Sightings, cameras_of, sightings


def in_frames(
    T_frame_world: jaxlie.SE3, points_world: Float[Array, "P 3"]
) -> Float[Array, "3 P N"]:
    """Points of the world in each of N frames, coordinates first, m."""
    R = jnp.moveaxis(jax.vmap(rotation_matrix)(T_frame_world.rotation()), 0, -1)
    shift = T_frame_world.translation().T[:, None]
    return jnp.sum(R[:, :, None] * points_world.T[None, :, :, None], axis=1) + shift


def e1(
    rig: CameraRig,
    markers: MarkerMap,
    corners_px: Float[Array, "C M 4 2"],
    visible: Bool[Array, "C M"],
    T_vehicle_world: jaxlie.SE3,
) -> Float[Array, ""]:
    """Image-space error, pixel^2 (Eq. 3): squared distances of all visible corners.

        e1(T_vw) = sum_ij |u_ij - project_j(T_jv T_vw p_i)|^2

    Pixels are raw: the lens is part of the projection.

    Args:
        rig: C cameras j, with T_jv = `Ts_camera_vehicle`.
        markers: M markers, whose corners p_i are in the world.
        corners_px: u_ij, (C, M, 4, 2).
        visible: (C, M).
        T_vehicle_world: T_vw.

    Source: Liu, Schofield, Shan (2023), Eq. 3.
    """
    seen = sightings(rig, markers, corners_px, visible)
    corners_world = markers.corners_world_m[seen.marker_index].reshape(-1, 3)
    points = in_frames(jaxlie.SE3(T_vehicle_world.wxyz_xyz[None]), corners_world)
    return jnp.sum(reprojection_rows(rig, seen)(points)[0] ** 2)


def e2(
    markers: MarkerMap,
    visible: Bool[Array, "C M"],
    T_vehicle_world: jaxlie.SE3,
    T_vehicle_world_prior: jaxlie.SE3,
) -> Float[Array, ""]:
    """Object-space error, m^2 (Eq. 14): squared distances of the corners to their prediction.

        e2(T_vw) = sum_i |T_vw p_i - T_w p_i|^2

    in the vehicle frame, over the corners p_i of the markers in view. A marker seen by two cameras
    counts once.

    Args:
        markers: M markers.
        visible: (C, M).
        T_vehicle_world: T_vw.
        T_vehicle_world_prior: T_w, the filter's prediction.

    Source: Liu, Schofield, Shan (2023), Eq. 14.
    """
    corners = markers.corners_world_m
    gap = transform_points(T_vehicle_world, corners) - transform_points(
        T_vehicle_world_prior, corners
    )
    in_view = jnp.any(visible, axis=0)
    return jnp.sum(jnp.where(in_view[:, None, None], gap, 0) ** 2)


# Residuals (2, P, N) of P corners under N poses, in units of their sigma, and their derivative by
# a shift of the corners, (3, 2, P, N), per m.
Rows = tuple[Float[Array, "2 P N"], Float[Array, "3 2 P N"]]


def reprojection_rows(rig: CameraRig, seen: Sightings) -> Callable[[Float[Array, "3 P N"]], Rows]:
    """Projected minus observed corners over sigma, zero in hidden lanes, and their derivatives.

    The parts that do not depend on the pose are computed here, once.

    Returns:
        A function of each sighting's own corners in the vehicle frame, P = 4 D of them, m.
    """
    of_corner = jnp.repeat(jnp.arange(seen.camera_index.shape[0]), 4)
    cameras, Ts_camera_vehicle = cameras_of(rig, seen)
    Rs_camera_vehicle = jax.vmap(rotation_matrix)(Ts_camera_vehicle.rotation())

    def last(leaf: Array) -> Array:
        """(D, ...) to (..., P, 1)."""
        return jnp.moveaxis(leaf[of_corner], 0, -1)[..., None]

    turn, shift = last(Rs_camera_vehicle), last(Ts_camera_vehicle.translation())
    hidden = last(~seen.visible)
    weight = jnp.where(hidden, 0, 1 / seen.sigma_px.reshape(-1, 1))
    gain = last(cameras.focal_px) * weight[None]  # (2, P, 1)
    corners_px = seen.corners_px.reshape(-1, 2).T[..., None]
    target = (last(cameras.center_px) - corners_px) * weight[None]
    coefficients, lens_index = last(cameras.distortion), last(cameras.lens_index)

    def rows(points: Array) -> Rows:
        in_camera = jnp.sum(turn * points[None], axis=1) + shift
        per_lens = [image_of(lens, in_camera, coefficients) for lens in cameras.lenses]
        image, slope = per_lens[0]
        for index, (other_image, other_slope) in enumerate(per_lens[1:], start=1):
            image = jnp.where((lens_index == index)[None], other_image, image)
            slope = jnp.where((lens_index == index)[None, None], other_slope, slope)
        residual = jnp.where(hidden[None], 0, image * gain + target)
        slope = jnp.sum(turn[:, :, None] * slope[:, None], axis=0) * gain[None]
        return residual, jnp.where(hidden[None, None], 0, slope)

    return rows


def pinhole_rows(
    corners_n: Float[Array, "P 2"], unit: Float[Array, ""]
) -> Callable[[Float[Array, "3 P N"]], Rows]:
    """As `reprojection_rows` for a camera of focal length 1, in multiples of `unit`.

    Args:
        corners_n: (P, 2) observed corners, normalised image coordinates.
        unit: in which residuals are counted.

    Returns:
        A function of the corners in the camera frame.
    """

    def rows(points: Array) -> Rows:
        image, slope = image_of("none", points, jnp.zeros(MOST_COEFFICIENTS, points.dtype))
        return (image - corners_n.T[..., None]) / unit, slope / unit

    return rows


def wrench(
    rows: Rows, points: Float[Array, "3 P N"]
) -> tuple[Float[Array, "3 N"], Float[Array, "3 N"]]:
    """J'r of a shift and a turn of all points about the origin, computed without forming J.

    Returns:
        sum of slope * residual (3, N), the force, and its moment (3, N), the torque.
    """
    residual, slope = rows
    force = jnp.sum(slope * residual[None], axis=1)
    return jnp.sum(force, axis=1), jnp.sum(cross_product(points, force), axis=1)


def jacobian_by_twist(
    slope: Float[Array, "3 2 P N"], points: Float[Array, "3 P N"]
) -> Float[Array, "6 2*P N"]:
    """Derivative of residuals by a shift and a turn of all points about the origin."""
    both = jnp.concatenate([slope, cross_product(points[:, None], slope)])
    return both.reshape(6, -1, both.shape[-1])


def cross_product(a: Float[Array, "3 ..."], b: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
    """a x b, coordinates first."""
    return jnp.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def turn_arms(half: Float[Array, "3 N"], arms: Float[Array, "3 P N"]) -> Float[Array, "3 P N"]:
    """Arms turned by the quaternion (1, half), normalised."""
    swing = 2 * cross_product(half[:, None], arms)
    per_norm = 1 / (1 + jnp.sum(half**2, axis=0))
    return arms + (swing + cross_product(half[:, None], swing)) * per_norm[None, None]


class Nuisance(eqx.Module):
    """Directions t of g independent groups in which residuals (m, N) of N poses may be moved."""

    slopes: Float[Array, "t m g N"]  # J_t, in units of the prior's sigma
    gains: Float[Array, "t m g N"]  # (I + J_t' J_t)^-1 J_t'
    log_share: Float[Array, " N"]  # -log |I + J_t' J_t| / 2, what the residuals leave of the prior

    @staticmethod
    def from_slopes(slopes: Float[Array, "t m g N"]) -> "Nuisance":
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
        """Eliminate the error from residuals, or from derivatives of them; its prior adds rows."""
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
        """Both as a nuisance that is new in every frame, with a single lane for all poses."""
        return Nuisance.from_slopes(jnp.concatenate([self.places, self.turns])[..., None])


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
    moves = jacobian_by_twist(slope, points)[..., 0]  # (6, 2 P)
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
