"""Poses refined on the corners by Levenberg-Marquardt, which optimistix runs.

Unknowns are local and scaled: a rotation vector about a pivot (the markers in view) and a shift
in units of the pivot's distance. About the marker's own centre rotation and translation hardly
interact, and the damping lambda*I treats all six alike.

The paper minimises e1 (Eq. 3) from both IPPE poses; see `candidates.py` for that step.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxnav.geometry import ON_GROUND, on_last_axis, safe_norm, skew, transform_points
from jaxnav.ippe import PosePair, ippe_square
from jaxnav.levenberg_marquardt import ImplicitGradient, NormalEquationsLM, moving_with
from jaxnav.markers import CORNER_SIGNS, MarkerMap
from jaxnav.observation import Sightings, sightings
from jaxnav.pair_lanes import solve_pairs
from jaxnav.residuals import reprojection_residuals
from jaxnav.rig import CameraRig
from jaxnav.small_matrices import cholesky, product, solve_lower

# An angle is known to about a radian, and a distance to about itself, before any corner is
# looked at. Bounds the covariance where the corners say nothing.
_PRIOR_SIGMA = 1.0


class RefinedPose(eqx.Module):
    """Result of one refinement.

    A lane whose numbers overflowed has an infinite cost, is not `converged`, and holds the start
    and an identity covariance.
    """

    T_vehicle_world: jaxlie.SE3
    cost: Float[Array, ""]  # sum of (residual / sigma)^2: e1 in pixel^2 where sigma is 1 px
    covariance: Float[Array, "6 6"]  # of xi in T_world_vehicle * exp(xi): vehicle axes, (m, rad)
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def refine_pose(
    rig: CameraRig,
    markers: MarkerMap,
    corners_px: Float[Array, "C M 4 2"],
    visible: Bool[Array, "C M"],
    T_vehicle_world: jaxlie.SE3,
    corner_sigma_px: Float[Array, "*sigma"] | float = 1.0,
    max_steps: int = 100,
) -> RefinedPose:
    """The local minimum of e1 next to a pose: all cameras, all markers, all corners at once.

    Args:
        corners_px: (C, M, 4, 2) raw pixels.
        visible: (C, M).
        T_vehicle_world: where to start.
        corner_sigma_px: standard deviation of a corner coordinate, a number or (C, M, 4).
        max_steps: bound on the LM steps; a lane that needs more is not `converged`.
    """
    seen = sightings(rig, markers, corners_px, visible, corner_sigma_px)
    return refine_sightings(rig, markers, seen, T_vehicle_world, max_steps)


def refine_sightings(
    rig: CameraRig,
    markers: MarkerMap,
    seen: Sightings,
    T_vehicle_world: jaxlie.SE3,
    max_steps: int,
    ground_plane: bool = False,
) -> RefinedPose:
    """`refine_pose` on sightings that have been gathered already.

    With `ground_plane` a level start stays level on the ground: the vehicle's x, y and heading
    alone are refined, and the covariance is that of these three.
    """
    pixels = reprojection_residuals(rig, seen)

    def residual(corners_vehicle: Array) -> Array:
        return (pixels(corners_vehicle) / seen.sigma_px[..., None]).reshape(-1)

    any_visible = jnp.any(seen.visible)
    weight = seen.visible.astype(seen.corners_px.dtype)[:, None]
    centers_world = markers.Ts_world_marker.translation()[seen.marker_index]
    center_world = jnp.sum(weight * centers_world, axis=0) / jnp.maximum(jnp.sum(weight), 1)
    corners_world = markers.corners_world_m

    T, steps, converged = _minimise(
        residual, T_vehicle_world, corners_world, center_world, any_visible, max_steps, ground_plane
    )
    chart = _chart(T, corners_world, center_world)
    free = _directions(ground_plane, chart.pivot.dtype)
    here = jnp.zeros(free.shape[1], chart.pivot.dtype)
    J = jax.jacfwd(lambda y: residual(chart.points(free @ y)))(here)
    cost = jnp.sum(residual(chart.points(free @ here)) ** 2)
    covariance = _body_covariance(chart, J, free)
    numbers = jnp.concatenate([T.wxyz_xyz, cost[None], covariance.reshape(-1)])
    finite = jnp.all(jnp.isfinite(numbers))
    return RefinedPose(
        T_vehicle_world=jaxlie.SE3(jnp.where(finite, T.wxyz_xyz, T_vehicle_world.wxyz_xyz)),
        cost=jnp.where(finite, cost, jnp.inf),
        covariance=jnp.where(finite, covariance, jnp.eye(6, dtype=covariance.dtype)),
        steps=steps,
        converged=converged & any_visible & finite,
    )


class _Chart(eqx.Module):
    """Local coordinates around a pose: y = (shift / scale, turn about the pivot).

    The turn is the rotation by the quaternion (1, turn / 2), normalised: equal to the rotation
    vector to second order, smooth everywhere and free of sin(x) / x.
    """

    T: jaxlie.SE3
    pivot: Float[Array, " 3"]  # in the target frame of T
    arms: Float[Array, "*points 3"]  # from the pivot to the points, at y = 0
    scale: Float[Array, ""]  # m

    def points(self, y: Float[Array, " 6"]) -> Float[Array, "*points 3"]:
        """The points in the target frame, moved by y."""
        turn = on_last_axis(y[3:], self.arms)
        swing = jnp.cross(turn, self.arms)
        swing = (swing + jnp.cross(turn / 2, swing)) / (1 + jnp.sum(y[3:] ** 2) / 4)
        return self.arms + swing + on_last_axis(self.pivot + self.scale * y[:3], self.arms)

    def transform(self, y: Float[Array, " 6"]) -> jaxlie.SE3:
        """The transform itself, moved by y."""
        turn = jaxlie.SO3(jnp.append(jnp.ones(1, y.dtype), y[3:] / 2)).normalize()
        arm = self.T.translation() - self.pivot
        return jaxlie.SE3.from_rotation_and_translation(
            (turn @ self.T.rotation()).normalize(), turn @ arm + self.pivot + self.scale * y[:3]
        )


def _chart(T: jaxlie.SE3, points_source: Array, center_source: Array) -> _Chart:
    pivot = transform_points(T, center_source)
    points = transform_points(T, points_source)
    arms = points - on_last_axis(pivot, points)
    return _Chart(T, pivot, arms, jnp.maximum(safe_norm(pivot), 1e-3))


def _minimise(
    residual: Callable[[Array], Array],
    T_start: jaxlie.SE3,
    points_source: Array,
    center_source: Array,
    constrained: Array,
    max_steps: int,
    ground_plane: bool = False,
) -> tuple[jaxlie.SE3, Array, Array]:
    """LM on residual(points in the target frame), from a pose.

    Gradients are those of the implicit function at the minimum: right only where `converged`, and
    independent of the start.
    """
    chart = _chart(jax.lax.stop_gradient(T_start), points_source, center_source)
    free = _directions(ground_plane, chart.pivot.dtype)

    def fn(y: Array, args: None) -> Array:
        # Without a visible corner y itself is the residual: nothing moves, no 0 / 0.
        return jnp.concatenate([residual(chart.points(free @ y)), jnp.where(constrained, 0, y)])

    dtype = chart.pivot.dtype
    tolerance = 1e-12 if dtype == jnp.float64 else 1e-6  # of the cost, what is left to gain
    solver = NormalEquationsLM(rtol=tolerance, atol=tolerance)
    solution: optx.Solution = optx.least_squares(
        fn,
        solver,
        jnp.zeros(free.shape[1], dtype),
        max_steps=max_steps,
        adjoint=ImplicitGradient(),
        throw=False,
    )
    return (
        chart.transform(free @ solution.value),
        solution.stats["num_steps"],
        jnp.asarray(solution.result == optx.RESULTS.successful),
    )


def _directions(ground_plane: bool, dtype: jnp.dtype) -> Array:
    """The directions of the chart in which a pose is refined, (6, 6) or (6, 3).

    The frame the chart lives in is the vehicle's: on the ground it shifts along x and y and turns
    about z.
    """
    return jnp.asarray(ON_GROUND if ground_plane else np.eye(6), dtype)


def _body_covariance(chart: _Chart, J: Array, free: Array) -> Array:
    """Covariance of xi in T_world_vehicle * exp(xi) from the whitened Jacobian in the chart.

    Inverted in the chart, where the information matrix is well conditioned, and carried over:
    y moves T_vehicle_world on the left by (scale * shift + pivot x turn, turn), and xi is minus
    that.
    """
    information = J.T @ J + jnp.eye(J.shape[1], dtype=J.dtype) / _PRIOR_SIGMA**2
    factor = cholesky(information)
    eye = jnp.eye(3, dtype=J.dtype)
    carry = jnp.block([[chart.scale * eye, skew(chart.pivot)], [jnp.zeros_like(eye), eye]])
    root = solve_lower(factor, product(carry, free).T)
    return product(root.T, root)


def solve_marker(
    corners_n: Float[Array, "4 2"], size_m: Float[Array, ""] | float, max_steps: int = 100
) -> PosePair:
    """Both poses of one marker in one camera, each refined to its local minimum by LM.

    Args and result as `ippe_square`; `reprojection_error` is the refined one.
    """
    corners_n = jnp.asarray(corners_n)
    start = ippe_square(corners_n, size_m)
    marker = _SingleMarker(corners_n, jnp.asarray(size_m, corners_n.dtype))

    def one(T_start: jaxlie.SE3) -> tuple[Array, Array]:
        origin = jnp.zeros(3, corners_n.dtype)
        T, _, _ = _minimise(
            marker.residual, T_start, marker.corners_m, origin, jnp.asarray(True), max_steps
        )
        return T.wxyz_xyz, marker.error(T)

    wxyz_xyz, errors = jax.vmap(one)(start.T_camera_marker)
    order = jnp.where(errors[0] <= errors[1], jnp.array([0, 1]), jnp.array([1, 0]))
    return PosePair(jaxlie.SE3(wxyz_xyz[order]), errors[order])


class _SingleMarker(eqx.Module):
    """What one camera sees of one marker."""

    corners_n: Float[Array, "4 2"]
    size_m: Float[Array, ""]

    @property
    def corners_m(self) -> Float[Array, "4 3"]:
        """In the marker's own frame."""
        return self.size_m / 2 * jnp.asarray(CORNER_SIGNS, self.corners_n.dtype)

    @property
    def unit(self) -> Float[Array, ""]:
        """A hundredth of the marker's spread: a hundred "pixels" across, whatever the units."""
        offsets = self.corners_n - jnp.mean(self.corners_n, axis=0, keepdims=True)
        spread = safe_norm(offsets.reshape(-1))
        return jnp.where(spread > 0, spread, 1) / 100

    def residual(self, points: Float[Array, "4 3"]) -> Float[Array, " 8"]:
        """In units, of corners at these places in the camera's frame."""
        depth = jnp.maximum(points[:, 2:], 1e-3 * safe_norm(points)[:, None])
        return ((points[:, :2] / depth - self.corners_n) / self.unit).reshape(-1)

    def error(self, T_camera_marker: jaxlie.SE3) -> Float[Array, ""]:
        """RMS over the eight coordinates, in units of the corners."""
        residual = self.residual(transform_points(T_camera_marker, self.corners_m))
        return self.unit * safe_norm(residual) / np.sqrt(8)


@jax.jit
def solve_markers(corners_n: Float[Array, "B 4 2"], size_m: Float[Array, " B"]) -> PosePair:
    """`solve_marker` for a batch, by lanes: (B, 4, 2) corners and (B,) sides give axes (B, 2).

    A marker's result is the same in every batch. Corners that are not finite give NaN.
    """
    return _solve_pairs(corners_n, size_m)


@jax.custom_jvp
def _solve_pairs(corners_n: Array, size_m: Array) -> PosePair:
    return solve_pairs(corners_n, size_m)


@_solve_pairs.defjvp
def _solve_pairs_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[PosePair, PosePair]:
    """By the implicit function theorem, as the derivatives of `solve_marker`."""
    pair = _solve_pairs(*primals)
    wxyz_xyz = pair.T_camera_marker.wxyz_xyz
    both = jax.vmap(_at_minimum, in_axes=(0, None, None))
    _, (t_poses, t_errors) = jax.jvp(
        lambda corners_n, size_m: jax.vmap(both)(wxyz_xyz, corners_n, size_m), primals, tangents
    )
    return pair, PosePair(jaxlie.SE3(t_poses), t_errors)


def _at_minimum(wxyz_xyz: Array, corners_n: Array, size_m: Array) -> tuple[Array, Array]:
    """A refined pose and its error, which move with the corners and the size as minima do."""
    T = jaxlie.SE3(jax.lax.stop_gradient(wxyz_xyz))
    marker = _SingleMarker(corners_n, size_m)
    here = jnp.zeros(6, wxyz_xyz.dtype)
    y = moving_with(here, (T, marker), gradient=_gradient_of_marker, residual=None)
    moved = _chart_of_marker(T, marker).transform(y)
    return moved.wxyz_xyz, marker.error(moved)


def _chart_of_marker(T: jaxlie.SE3, marker: _SingleMarker) -> _Chart:
    return _chart(T, marker.corners_m, jnp.zeros(3, marker.corners_n.dtype))


def _gradient_of_marker(y: Array, _: None, inputs: tuple[jaxlie.SE3, _SingleMarker]) -> Array:
    T, marker = inputs
    chart = _chart_of_marker(T, marker)
    return jax.grad(lambda z: jnp.sum(marker.residual(chart.points(z)) ** 2) / 2)(y)
