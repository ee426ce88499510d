"""Residuals of the odometry's calibration: motion between readings, and corners of markers.

The unknowns of a drive are the five parameters and, at every node, the planar pose and the errors
of the reading that follows it. One interval, with one reading, leads from node to node:

    speed    = speed_scale * (read - sigma_v e_v)
    steering = steering_gain * (read - sigma_d e_d) + steering_offset
    node'    = advance_bicycle(node, speed, steering, dt, wheelbase) + slip

A view shows the corners of a marker from the pose at `stamp - camera_delay`. The errors are
unknowns, not variances added to the slip: a regression on noisy readings would find too small a
gain (Fuller 1987, "Measurement Error Models", section 1.1), and noise would look like steering.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from jaxnav.calibrate.odometry.drive import Course, Intervals, MarkerViews, ReadingSigma
from jaxnav.calibrate.robust import sighting_cost, sighting_weight
from jaxnav.core.models.geometry import T_world_vehicle_from_planar, transform_points
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import advance_bicycle

NAMES = ("speed_scale", "steering_gain", "steering_offset_rad", "wheelbase_m", "camera_delay_s")
# Slip along, across (m) and about (rad), for a second: wheels don't roll exactly, and the servo
# turns between two readings. It is well below the effect of the noise of usual readings, so it
# matters little if their sigmas are right.
SLIP_PER_SQRT_S = (5e-4, 3e-4, 1e-3)
NODE, NEXT = 5, 3  # unknowns of an interval: of its node, and of the next node; then parameters
_PADDED = 512  # sizes are rounded up, so that drives of about one length share a program


class Blocks(NamedTuple):
    """Cost and normal equations at one point, interval by interval."""

    cost: float  # sum of squares, in which outliers count less
    # of a node (5), the next pose (3) and the parameters (5)
    information: Float[np.ndarray, "N 13 13"]
    gradient: Float[np.ndarray, "N 13"]
    view_chi2: Float[np.ndarray, " V"]  # of each view's eight residuals
    views_px: Float[np.ndarray, "V 4 2"]  # residuals in pixels


class Model:
    """Computes the residuals of one course under one rig and one map."""

    def __init__(self, course: Course, rig: CameraRig, markers: MarkerMap, sigma: ReadingSigma):
        self._count = len(course.intervals.dt_s), len(course.views.time_s)
        intervals, views = (
            Intervals(*padded(course.intervals)),
            MarkerViews(*padded(course.views)),
        )
        # Padding intervals link nothing and begin after all others.
        intervals.begin_s[self._count[0] :] = np.inf
        intervals.linked[self._count[0] :] = 0.0
        used = np.arange(len(views.time_s)) < self._count[1]
        self._data = jax.tree.map(jnp.asarray, (intervals, views, used))
        self._world = rig, markers, jnp.asarray(sigma)

    def blocks(self, nodes: Float[np.ndarray, "nodes 5"], theta: Float[np.ndarray, " 5"]) -> Blocks:
        """Compute the blocks at (N + 1, 5) nodes and (5,) parameters, on the host."""
        intervals, views = self._count
        size = len(self._data[0].dt_s) + 1
        filled = np.concatenate([nodes, np.repeat(nodes[-1:], size - len(nodes), axis=0)])
        filled[len(nodes) :, 3:] = 0.0
        cost, information, gradient, chi2, views_px = jax.device_get(
            _blocks(*self._world, *self._data, filled, theta)
        )
        return Blocks(
            float(cost),
            information[:intervals],
            gradient[:intervals],
            chi2[:views],
            views_px[:views],
        )


def corrected(
    theta: Float[Array, " 5"], speed_mps: Float[Array, "*N"], steering_rad: Float[Array, "*N"]
) -> tuple[Float[Array, "*N"], Float[Array, "*N"]]:
    """Correct the speed and steering of a reading by the parameters."""
    return theta[0] * speed_mps, theta[1] * steering_rad + theta[2]


def _process(local: Array, interval: Intervals, sigma: Array) -> Float[Array, " 5"]:
    """Whitened residuals: the reading's two errors, and the slip along, across and about."""
    node, following, theta = local[:NODE], local[NODE : NODE + NEXT], local[NODE + NEXT :]
    driven = _dead_reckoned(node, theta, interval, sigma, interval.dt_s)
    cosine, sine = jnp.cos(node[2]), jnp.sin(node[2])
    dx, dy, dpsi = following - driven
    slip = jnp.stack([cosine * dx + sine * dy, cosine * dy - sine * dx, dpsi])
    slip = slip / (jnp.asarray(SLIP_PER_SQRT_S) * jnp.sqrt(interval.dt_s))
    return jnp.concatenate([node[3:], interval.linked * slip])


def _view(
    local: Array,
    interval: Intervals,
    sigma: Array,
    view: MarkerViews,
    rig: CameraRig,
    markers: MarkerMap,
) -> Float[Array, " 8"]:
    """Residuals of a marker's corners in one camera, predicted minus seen, px.

    Between two nodes the pose follows the arc; the slip of the interval is spread evenly over it.
    """
    node, following, theta = local[:NODE], local[NODE : NODE + NEXT], local[NODE + NEXT :]
    after_s = view.time_s - theta[4] - interval.begin_s
    pose = _dead_reckoned(node, theta, interval, sigma, after_s)
    slip = following - _dead_reckoned(node, theta, interval, sigma, interval.dt_s)
    pose = pose + interval.linked * (after_s / interval.dt_s) * slip
    T_vehicle_world = T_world_vehicle_from_planar(pose).inverse()
    points_vehicle = transform_points(T_vehicle_world, markers.corners_world_m[view.marker])
    camera = jax.tree.map(lambda leaf: leaf[view.camera], rig.cameras)
    T_camera_vehicle = jax.tree.map(lambda leaf: leaf[view.camera], rig.Ts_camera_vehicle)
    pixels = camera.project(transform_points(T_camera_vehicle, points_vehicle))
    return (pixels - view.corners_px).reshape(8)


def _dead_reckoned(
    node: Array, theta: Array, interval: Intervals, sigma: Array, dt_s: Array
) -> Array:
    """The pose by odometry after the time dt_s of an interval."""
    errors = sigma * node[3:]
    speed_mps, steering_rad = corrected(
        theta, interval.speed_mps - errors[0], interval.steering_rad - errors[1]
    )
    return advance_bicycle(node[:3], speed_mps, steering_rad, dt_s, theta[3])


@jax.jit
def _blocks(
    rig: CameraRig,
    markers: MarkerMap,
    sigma: Array,
    intervals: Intervals,
    views: MarkerViews,
    used: Array,
    nodes: Array,
    theta: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """Compute the fields of `Blocks`, those of padding included."""
    count = intervals.dt_s.shape[0]
    shared = jnp.broadcast_to(theta, (count, theta.shape[0]))
    local = jnp.concatenate([nodes[:-1], nodes[1:, :NEXT], shared], axis=1)

    def process(one: Array, interval: Intervals) -> tuple[Array, Array]:
        residual = _process(one, interval, sigma)
        return residual, residual

    J, r = jax.vmap(jax.jacfwd(process, has_aux=True))(local, intervals)
    information = jnp.einsum("nri,nrj->nij", J, J)
    gradient = jnp.einsum("nri,nr->ni", J, r)

    rows = jnp.searchsorted(intervals.begin_s, views.time_s - theta[4], side="right") - 1
    index = jnp.clip(rows, views.first, views.last)

    def seen(one: Array, interval: Intervals, view: MarkerViews) -> tuple[Array, Array]:
        pixels = _view(one, interval, sigma, view, rig, markers)
        return pixels / jnp.repeat(view.sigma_px, 2), pixels

    at = jax.tree.map(lambda column: column[index], intervals)
    Jv, px = jax.vmap(jax.jacfwd(seen, has_aux=True))(local[index], at, views)
    rv = px / jnp.repeat(views.sigma_px, 2, axis=1)
    chi2 = jnp.sum(rv**2, axis=1)
    weight = jnp.where(used, sighting_weight(chi2), 0.0)
    information = information.at[index].add(
        jnp.einsum("vri,vrj->vij", Jv * weight[:, None, None], Jv)
    )
    gradient = gradient.at[index].add(jnp.einsum("vri,vr->vi", Jv, rv * weight[:, None]))
    cost = jnp.sum(r**2) + jnp.sum(jnp.where(used, sighting_cost(chi2), 0.0))
    return cost, information, gradient, chi2, px.reshape(-1, 4, 2)


def padded(columns: Intervals | MarkerViews) -> list[Shaped[np.ndarray, "rows ..."]]:
    """Pad columns to a multiple of `_PADDED` rows by repeating the last row."""
    extra = -len(columns[0]) % _PADDED
    return [np.concatenate([column, np.repeat(column[-1:], extra, axis=0)]) for column in columns]
