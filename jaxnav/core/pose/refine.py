"""Poses refined on the corners by Levenberg-Marquardt, which optimistix runs.

Unknowns are local and scaled: a rotation vector about a pivot (the markers in view) and a shift
in units of the pivot's distance. About the marker's own centre rotation and translation hardly
interact, and the damping lambda*I treats all six alike.

The paper minimises e1 (Eq. 3) from both IPPE poses; see `candidates.py` for that step.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optimistix as optx
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.linalg.levenberg_marquardt import (
    ImplicitGradient,
    LMState,
    NormalEquations,
    NormalEquationsLM,
    implicit_root,
)
from jaxnav.core.linalg.small_matrices import cholesky, gram, product, solve_lower
from jaxnav.core.models.geometry import ON_GROUND, rotation_matrix, safe_norm, skew
from jaxnav.core.models.markers import CORNER_SIGNS, MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.ippe import PosePair, ippe_square
from jaxnav.core.pose.observation import Sightings, sightings
from jaxnav.core.pose.pair_lanes import solve_pairs
from jaxnav.core.pose.residuals import (
    Nuisance,
    Rows,
    camera_slopes,
    cross_product,
    pinhole_rows,
    reprojection_rows,
    turn_arms,
    wrench,
)

# Prior sigma of an angle, rad, and of a distance, as a share of itself. It bounds the covariance
# in directions that the corners do not determine.
_PRIOR_SIGMA = 1.0
# What the next step may still gain at a minimum, in units of the cost, a tenth of a sigma, and as a
# share of it, which float32 can't tell. Of two cameras on one marker it is 1e-4 at most at minima,
# and more than this in 25 of 29 lanes on the way from one to another, after 12 steps.
_AT_MINIMUM, _AT_MINIMUM_SHARE = 1e-2, 3e-6


class Candidates(eqx.Module):
    """N poses of the vehicle at local minima of e1; `find_candidates` sorts them by it.

    Lanes that are not `valid` hold finite numbers; of a lane whose numbers overflowed, as
    `refine_pose` returns it, costs are infinite, and pose and covariance the start and identity.
    """

    T_vehicle_world: jaxlie.SE3  # batch axis (N,)
    # The paper's, Eq. 3: every sigma is 1 px. Of a rig with sigmas: in the cameras' most probable
    # errors, and what these cost.
    e1_px2: Float[Array, "*N"]
    cost: Float[Array, "*N"]  # sum of (residual / sigma)^2, which the refinement minimises
    covariance: Float[Array, "*N 6 6"]  # of xi in T_world_vehicle * exp(xi): vehicle axes, (m, rad)
    valid: Bool[Array, "*N"]
    converged: Bool[Array, "*N"]  # it is within a tenth of a sigma of the minimum
    steps: Int[Array, "*N"]

    @staticmethod
    def none(count: int, dtype: DTypeLike) -> "Candidates":
        """`count` lanes, none of them valid."""
        zeros = jnp.zeros(count, dtype)
        return Candidates(
            T_vehicle_world=jaxlie.SE3(jnp.zeros((count, 7), dtype).at[:, 0].set(1)),
            e1_px2=zeros,
            cost=zeros,
            covariance=jnp.zeros((count, 6, 6), dtype),
            valid=zeros > 0,
            converged=zeros > 0,
            steps=jnp.zeros(count, int),
        )

    @property
    def least_cost(self) -> Float[Array, ""]:
        """The cost of the best candidate; inf without one."""
        return jnp.min(jnp.where(self.valid, self.cost, jnp.inf))


def refine_pose(
    rig: CameraRig,
    markers: MarkerMap,
    corners_px: Float[Array, "C M 4 2"],
    visible: Bool[Array, "C M"],
    T_vehicle_world: jaxlie.SE3,
    corner_sigma_px: Float[Array, "*sigma"] | float = 1.0,
    max_steps: int = 100,
) -> Candidates:
    """The local minimum of e1 (Eq. 3) next to a pose, over all cameras, markers and corners.

    Corners are weighed by 1 / sigma^2. The covariance is (J'J)^-1 of the whitened residuals.

    Args:
        rig: C cameras.
        markers: M markers.
        corners_px: (C, M, 4, 2) raw pixels.
        visible: (C, M).
        T_vehicle_world: where to start.
        corner_sigma_px: standard deviation of a corner coordinate, a number or (C, M, 4).
        max_steps: bound on the LM steps; a lane that needs more may be not `converged`.

    Source: Liu, Schofield, Shan (2023), Eq. 3 and below.
    """
    seen = sightings(rig, markers, corners_px, visible, corner_sigma_px)
    start = jaxlie.SE3(T_vehicle_world.wxyz_xyz[None])
    refined = refine_sightings(rig, markers, seen, start, max_steps)
    return jax.tree.map(lambda leaf: leaf[0], refined)


def refine_sightings(
    rig: CameraRig,
    markers: MarkerMap,
    seen: Sightings,
    Ts_vehicle_world: jaxlie.SE3,
    max_steps: int,
    ground_plane: bool = False,
    wanted: Bool[Array, " N"] | None = None,
) -> Candidates:
    """`refine_pose` from N poses, on sightings that have been gathered already.

    All lanes take as many steps as the slowest; those that are not `wanted` take none.

    Args:
        rig: C cameras.
        markers: M markers.
        seen: D sightings.
        Ts_vehicle_world: N poses at which to start.
        max_steps: bound on the LM steps.
        ground_plane: a level start stays level on the ground: only the vehicle's x, y and heading
            are refined, and the covariance is that of these three.
        wanted: (N,), which lanes to refine; None: all.
    """
    rows = reprojection_rows(rig, seen)
    any_visible = jnp.any(seen.visible)
    weight = seen.visible.astype(seen.corners_px.dtype)[:, None]
    centers_world = markers.Ts_world_marker.translation()[seen.marker_index]
    center_world = jnp.sum(weight * centers_world, axis=0) / jnp.maximum(jnp.sum(weight), 1)
    corners_world = markers.corners_world_m[seen.marker_index].reshape(-1, 3)
    # The chart's frame is the vehicle's: on the ground it shifts along x, y and turns about z.
    free = jnp.asarray(ON_GROUND if ground_plane else np.eye(6), corners_world.dtype)

    start = _chart(jax.lax.stop_gradient(Ts_vehicle_world), corners_world, center_world)
    constrained = jnp.full(start.scale.shape, any_visible)
    if wanted is not None:
        constrained = constrained & wanted

    moves = camera_slopes(rig, markers, seen)
    nuisance = None if moves is None else moves.nuisance()
    T, solution = _minimise(start, rows, free, constrained, max_steps, nuisance)
    chart = _chart(T, corners_world, center_world)
    residual, normal = chart.linearised(rows, free, nuisance)(
        jnp.zeros_like(chart.pivot, shape=(free.shape[1], chart.scale.size))
    )
    cost = jnp.sum(residual**2, axis=0)
    sigma_px = jnp.tile(seen.sigma_px.reshape(-1), 2)[:, None]
    corners, errors = residual[: sigma_px.shape[0]], residual[sigma_px.shape[0] :]
    # What a nuisance costs in px^2, by the mean variance of the corners in view.
    unit_px2 = jnp.sum(weight * seen.sigma_px**2) / jnp.maximum(4 * jnp.sum(weight), 1)
    e1_px2 = jnp.sum((corners * sigma_px) ** 2, axis=0) + unit_px2 * jnp.sum(errors**2, axis=0)
    covariance, to_gain = jax.vmap(partial(_body_covariance, free=free), in_axes=(-1, -1, -1))(
        chart.pivot, chart.scale, normal
    )
    numbers = [T.wxyz_xyz, cost[:, None], covariance.reshape(*cost.shape, -1)]
    finite = jnp.all(jnp.isfinite(jnp.concatenate(numbers, axis=1)), axis=1)
    kept = jnp.where(finite[:, None], T.wxyz_xyz, Ts_vehicle_world.wxyz_xyz)
    unknown = jnp.eye(6, dtype=covariance.dtype)[None]
    return Candidates(
        T_vehicle_world=jaxlie.SE3(kept),
        e1_px2=jnp.where(finite, e1_px2, jnp.inf),
        cost=jnp.where(finite, cost, jnp.inf),
        covariance=jnp.where(finite[:, None, None], covariance, unknown),
        valid=finite & jnp.isfinite(e1_px2),
        converged=(to_gain < _AT_MINIMUM + _AT_MINIMUM_SHARE * cost) & any_visible & finite,
        steps=solution.steps,
    )


class _Chart(eqx.Module):
    """Local coordinates around N poses: y = (shift / scale, turn about the pivot), (6, N).

    The turn is the rotation by the quaternion (1, turn / 2), normalised: equal to the rotation
    vector to second order, smooth everywhere and free of sin(x) / x.
    """

    T: jaxlie.SE3
    pivot: Float[Array, "3 N"]  # in the target frame of T
    arms: Float[Array, "3 P N"]  # from the pivot to the points, at y = 0
    scale: Float[Array, " N"]  # m

    def linearised(
        self,
        rows: Callable[[Array], Rows],
        free: Float[Array, "6 n"],
        nuisance: Nuisance | None = None,
    ) -> Callable[[Float[Array, "n N"]], tuple[Array, NormalEquations]]:
        """Residuals (m, N) of the points moved by free @ y, and their normal equations.

        With a nuisance they are the residuals in its most probable value, and its prior's rows.
        """

        def at(y: Array) -> tuple[Array, NormalEquations]:
            y = jnp.sum(free[:, :, None] * y[None], axis=1)
            half = y[3:] / 2
            arms = turn_arms(half, self.arms)
            residual, slope = rows(arms + (self.pivot + self.scale[None] * y[:3])[:, None])
            about = in_chart(cross_product(arms[:, None], slope), half[:, None, None])
            J = jnp.concatenate([self.scale[None, None, None] * slope, about])
            J = J.reshape(6, -1, J.shape[-1])
            r = residual.reshape(J.shape[1:])
            if nuisance is not None:
                r, J = nuisance.eliminated(r), nuisance.eliminated(J)
                residual = r[: residual[..., 0].size].reshape(residual.shape)
            force, torque = wrench((residual, slope), arms)
            gradient = jnp.concatenate([self.scale[None] * force, in_chart(torque, half)])
            if free.shape[1] < 6:
                J = jnp.sum(J[:, None] * free[:, :, None, None], axis=0)
                gradient = jnp.sum(gradient[:, None] * free[:, :, None], axis=0)
            return r, NormalEquations(gram(J), gradient)

        def in_chart(about: Array, half: Array) -> Array:
            """Derivatives by a turn from here on, converted to derivatives by `half`."""
            return (about + cross_product(about, half)) / (1 + jnp.sum(half**2, axis=0))[None]

        return at

    def transform(self, y: Float[Array, "6 N"]) -> jaxlie.SE3:
        """The poses themselves, moved by y."""

        def one(T: jaxlie.SE3, pivot: Array, scale: Array, y: Array) -> jaxlie.SE3:
            turn = jaxlie.SO3(jnp.append(jnp.ones(1, y.dtype), y[3:] / 2)).normalize()
            arm = T.translation() - pivot
            return jaxlie.SE3.from_rotation_and_translation(
                (turn @ T.rotation()).normalize(), turn @ arm + pivot + scale * y[:3]
            )

        return jax.vmap(one, in_axes=(0, -1, -1, -1))(self.T, self.pivot, self.scale, y)


def _chart(
    T: jaxlie.SE3, points_source: Float[Array, "P 3"], center_source: Float[Array, " 3"]
) -> _Chart:
    R = jnp.moveaxis(jax.vmap(rotation_matrix)(T.rotation()), 0, -1)
    pivot = jnp.sum(R * center_source[None, :, None], axis=1) + T.translation().T
    offsets = points_source - center_source[None]
    arms = jnp.sum(R[:, :, None] * offsets.T[None, :, :, None], axis=1)
    return _Chart(T, pivot, arms, jnp.maximum(safe_norm(pivot.T), 1e-3))


def _minimise(
    chart: _Chart,
    rows: Callable[[Array], Rows],
    free: Float[Array, "6 n"],
    constrained: Bool[Array, " N"],
    max_steps: int,
    nuisance: Nuisance | None = None,
) -> tuple[jaxlie.SE3, LMState]:
    """Minimise by LM from the chart's poses: the poses found, and the solver's state.

    Gradients are those of the implicit function at the minimum: right only where `done`, and
    independent of the start.
    """
    linearised = chart.linearised(rows, free, nuisance)
    n, dtype = free.shape[1], chart.pivot.dtype

    def fn(y: Array, args: None) -> tuple[Any, NormalEquations]:
        # Without a visible corner the residuals are zero, and the pose stays.
        residual, normal = linearised(y)
        return jnp.where(constrained[None], residual, 0), NormalEquations(
            jnp.where(constrained[None, None], normal.information, 0),
            jnp.where(constrained[None], normal.gradient, 0),
        )

    tolerance = 1e-12 if dtype == jnp.float64 else 1e-6  # gain left, as a share of the cost
    solution: optx.Solution = optx.least_squares(
        fn,
        NormalEquationsLM(rtol=tolerance, atol=tolerance),
        jnp.zeros((n, chart.scale.shape[0]), dtype),
        has_aux=True,
        max_steps=max_steps,
        adjoint=ImplicitGradient(),
        throw=False,
    )
    y = jnp.sum(free[:, :, None] * solution.value[None], axis=1)
    return chart.transform(y), solution.state


def _body_covariance(
    pivot: Array, scale: Array, normal: NormalEquations, free: Array
) -> tuple[Array, Array]:
    """Covariance of xi in T_world_vehicle * exp(xi) from the whitened J'J in the chart; and what a
    step of Gauss and Newton would gain.

    Inverted in the chart, where the information matrix is well conditioned, and carried over:
    y moves T_vehicle_world on the left by (scale * shift + pivot x turn, turn), and xi is minus
    that.
    """
    eye = jnp.eye(3, dtype=pivot.dtype)
    prior = jnp.eye(free.shape[1], dtype=pivot.dtype) / _PRIOR_SIGMA**2
    factor = cholesky(normal.information + prior)
    carry = jnp.block([[scale * eye, skew(pivot)], [jnp.zeros_like(eye), eye]])
    root = solve_lower(factor, product(carry, free).T)
    to_gain = jnp.sum(solve_lower(factor, normal.gradient) ** 2)
    return product(root.T, root), to_gain


def solve_marker(
    corners_n: Float[Array, "4 2"], size_m: Float[Array, ""] | float, max_steps: int = 100
) -> PosePair:
    """Both poses of one marker in one camera, each refined by LM to its minimum of e1.

    Arguments and result are those of `ippe_square`; `reprojection_error` is the refined one.
    """
    corners_n = jnp.asarray(corners_n)
    start = ippe_square(corners_n, size_m)
    marker = _SingleMarker(corners_n, jnp.asarray(size_m, corners_n.dtype))
    chart = marker.chart(jax.lax.stop_gradient(start.T_camera_marker))
    free = jnp.eye(6, dtype=corners_n.dtype)
    T, _ = _minimise(chart, marker.rows, free, jnp.ones(2, bool), max_steps)
    errors = marker.errors(T)
    order = jnp.where(errors[0] <= errors[1], jnp.array([0, 1]), jnp.array([1, 0]))
    return PosePair(jaxlie.SE3(T.wxyz_xyz[order]), errors[order])


class _SingleMarker(eqx.Module):
    """Corners of one marker in one camera, with their residuals at N poses of it."""

    corners_n: Float[Array, "4 2"]
    size_m: Float[Array, ""]

    def chart(self, T_camera_marker: jaxlie.SE3) -> _Chart:
        """About the marker's own centre."""
        corners_m = self.size_m / 2 * jnp.asarray(CORNER_SIGNS, self.corners_n.dtype)
        return _chart(T_camera_marker, corners_m, jnp.zeros(3, self.corners_n.dtype))

    @property
    def unit(self) -> Float[Array, ""]:
        """A hundredth of the marker's spread: a hundred "pixels" across, whatever the units."""
        offsets = self.corners_n - jnp.mean(self.corners_n, axis=0, keepdims=True)
        spread = safe_norm(offsets.reshape(-1))
        return jnp.where(spread > 0, spread, 1) / 100

    @property
    def rows(self) -> Callable[[Array], Rows]:
        """Residuals in units, with their derivatives."""
        return pinhole_rows(self.corners_n, self.unit)

    def errors(self, T_camera_marker: jaxlie.SE3) -> Float[Array, " N"]:
        """RMS over the eight coordinates, in units of the corners."""
        chart = self.chart(T_camera_marker)
        residual, _ = self.rows(chart.arms + chart.pivot[:, None])
        return self.unit * safe_norm(residual.reshape(8, -1).T) / np.sqrt(8)


@jax.jit
def solve_markers(corners_n: Float[Array, "B 4 2"], size_m: Float[Array, " B"]) -> PosePair:
    """`solve_marker` for a batch, by lanes: (B, 4, 2) corners and (B,) sides give axes (B, 2).

    A marker's result is the same in every batch. Corners that are not finite give NaN.
    """
    return _solve_pairs(corners_n, size_m)


_solve_pairs = jax.custom_jvp(solve_pairs)


@_solve_pairs.defjvp
def _solve_pairs_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[PosePair, PosePair]:
    """Derivatives by the implicit function theorem, as those of `solve_marker`."""
    pair = _solve_pairs(*primals)
    wxyz_xyz = pair.T_camera_marker.wxyz_xyz
    _, (t_poses, t_errors) = jax.jvp(
        lambda *seen: jax.vmap(_at_minima)(wxyz_xyz, *seen), primals, tangents
    )
    return pair, PosePair(jaxlie.SE3(t_poses), t_errors)


def _at_minima(
    wxyz_xyz: Float[Array, "2 7"], corners_n: Array, size_m: Array
) -> tuple[Array, Array]:
    """Refined poses and their errors, with the derivatives of minima by corners and size."""
    T = jaxlie.SE3(jax.lax.stop_gradient(wxyz_xyz))
    marker = _SingleMarker(corners_n, size_m)
    here = jnp.zeros((6, 2), wxyz_xyz.dtype)
    y = implicit_root(here, (T, marker), gradient=_gradient_of_marker, residual=None)
    moved = marker.chart(T).transform(y)
    return moved.wxyz_xyz, marker.errors(moved)


def _gradient_of_marker(y: Array, _: None, inputs: tuple[jaxlie.SE3, _SingleMarker]) -> Array:
    T, marker = inputs
    linearised = marker.chart(T).linearised(marker.rows, jnp.eye(6, dtype=y.dtype))
    return linearised(y)[1].gradient
