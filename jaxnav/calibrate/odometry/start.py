"""First guess for a calibration of odometry: a roughly right course, with a branch for each view.

Every view of a marker has two poses (IPPE). Of all ways through them, the one is taken that fits
the present odometry best: Viterbi (1967). Between the chosen poses the course follows the odometry,
and the remaining error is spread over it.
"""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from jaxnav.calibrate.odometry.drive import Course, Intervals, MarkerViews
from jaxnav.calibrate.odometry.model import NODE, corrected, padded
from jaxnav.core.models.geometry import planar_from_T_world_vehicle, wrap_angle_np
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import advance_bicycle
from jaxnav.core.pose.ippe import ippe_from_rays

_MOST = 25.0  # largest cost of a view, or of a step between two: some detections are wrong
_ANCHORS_APART_S = 0.2


# Between two views in a row, whose own poses are rough, the odometry may be off by so much, and by
# a part of what it drove and turned: 0.2 with wrong parameters, 0.02 with nearly right ones.
_STEP_M, _STEP_RAD = 0.1, 0.15
LOOSE, TIGHT = 0.2, 0.02


def start(
    course: Course,
    rig: CameraRig,
    markers: MarkerMap,
    theta: Float[np.ndarray, " 5"],
    error: float = LOOSE,
) -> Float[np.ndarray, "nodes 5"]:
    """Find a first guess of the (N + 1, 5) nodes, see `model`.

    Args:
        theta: (5,), the present parameters.
        error: of the odometry with these parameters, as a part of what it drove and turned.
    """
    times_s = course.node_times_s
    driven = _dead_reckoned(course.intervals, theta)
    chosen, good = _branches(course, rig, markers, theta, times_s, driven, error)
    seen_s = course.views.time_s - theta[4]
    nodes = np.zeros((len(times_s), NODE))
    begins = np.concatenate([[0], np.flatnonzero(course.intervals.linked == 0) + 1])
    ends = np.concatenate([begins[1:], [len(times_s)]])
    for begin, end in zip(begins, ends, strict=True):
        own = (course.views.first == begin) & good
        if not own.any():
            own = course.views.first == begin
        anchor_s, poses = _thinned(seen_s[own], chosen[own])
        nodes[begin:end, :3] = _bent(times_s[begin:end], driven[begin:end], anchor_s, poses)
    return nodes


def _dead_reckoned(intervals: Intervals, theta: np.ndarray) -> np.ndarray:
    """(N + 1, 3): poses by odometry alone, from the origin."""
    columns = Intervals(*padded(intervals))  # drives of about one length share a program
    speed, steering = corrected(jnp.asarray(theta), columns.speed_mps, columns.steering_rad)
    dt_s = np.where(columns.linked > 0, columns.dt_s, 0.0)
    moved = np.asarray(_advanced(speed, steering, jnp.asarray(dt_s), jnp.asarray(theta[3])))
    return np.concatenate([np.zeros((1, 3)), moved[: len(intervals.dt_s)]])


@jax.jit
def _advanced(speed: Array, steering: Array, dt_s: Array, wheelbase_m: Array) -> Array:
    def one(pose: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        moved = advance_bicycle(pose, *row, wheelbase_m)
        return moved, moved

    return jax.lax.scan(one, jnp.zeros(3), (speed, steering, dt_s))[1]


def _branches(
    course: Course,
    rig: CameraRig,
    markers: MarkerMap,
    theta: np.ndarray,
    times_s: np.ndarray,
    driven: np.ndarray,
    error: float,
) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3): one of the two poses of each view, by the least total cost; and (V,), true where it
    fits one of its neighbours."""
    views = course.views
    columns = jax.tree.map(jnp.asarray, MarkerViews(*padded(views)))
    both = jax.device_get(_poses_of_views(rig, markers, columns))
    poses, distance = (column[: len(views.camera)] for column in both)
    cost = np.sum(distance**2, axis=2)
    cost = np.where(np.isfinite(cost), np.minimum(cost, _MOST), _MOST)
    poses = np.where(np.isfinite(poses), poses, 0.0)
    at = np.column_stack([np.interp(views.time_s - theta[4], times_s, c) for c in driven.T])
    new = np.concatenate([[True], np.diff(views.first) != 0])
    total, came = cost[0], np.zeros((len(at), 2), int)
    steps = np.zeros((len(at), 2, 2))
    for v in range(1, len(at)):
        if not new[v]:
            steps[v] = _step_cost(at[v - 1], at[v], poses[v - 1], poses[v], error)
        through = total[:, None] + steps[v]
        came[v] = np.argmin(through, axis=0)
        total = through[came[v], [0, 1]] + cost[v]
    ways = np.zeros(len(at), int)
    ways[-1] = int(np.argmin(total))
    for v in range(len(at) - 1, 0, -1):
        ways[v - 1] = came[v, ways[v]]
    rows = np.arange(len(at))
    own = cost[rows, ways]
    step_costs = np.concatenate([[_MOST], steps[rows[1:], ways[:-1], ways[1:]]])
    step_costs[new] = _MOST
    following = np.concatenate([step_costs[1:], [_MOST]])
    good = (own < _MOST) & (np.minimum(step_costs, following) < _MOST / 2)
    return poses[rows, ways], good


@jax.jit
def _poses_of_views(
    rig: CameraRig, markers: MarkerMap, views: MarkerViews
) -> tuple[Float[Array, "V 2 3"], Float[Array, "V 2 4"]]:
    """Both poses of each view, and the residual of each corner in standard deviations."""

    def one(view: MarkerViews) -> tuple[Array, Array]:
        camera = jax.tree.map(lambda leaf: leaf[view.camera], rig.cameras)
        rays_camera = camera.unproject(view.corners_px)
        Ts_camera_marker = ippe_from_rays(rays_camera, markers.size_m[view.marker])
        T_camera_vehicle = jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[view.camera])
        T_world_marker = jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[view.marker])

        def posed(wxyz_xyz: Array) -> tuple[Array, Array]:
            T_camera_marker = jaxlie.SE3(wxyz_xyz)
            T_world_vehicle = T_world_marker @ T_camera_marker.inverse() @ T_camera_vehicle
            points_camera = jax.vmap((T_camera_marker @ T_world_marker.inverse()).apply)(
                markers.corners_world_m[view.marker]
            )
            off_px = camera.project(points_camera) - view.corners_px
            distance = jnp.sqrt(jnp.sum(off_px**2, axis=1)) / view.sigma_px
            return planar_from_T_world_vehicle(T_world_vehicle), distance

        return jax.vmap(posed)(Ts_camera_marker.wxyz_xyz)

    return jax.vmap(one)(views)


def _step_cost(
    a: np.ndarray, b: np.ndarray, befores: np.ndarray, afters: np.ndarray, error: float
) -> np.ndarray:
    """(2, 2): costs of the steps from each of two poses to each of the next two, by odometry."""
    turn = b[2] - a[2]
    driven_m = _turned(b[:2] - a[:2], -a[2])
    seen_m = _turned(afters[None, :, :2] - befores[:, None, :2], -befores[:, None, 2])
    off_m = np.linalg.norm(seen_m - driven_m, axis=-1)
    off_rad = np.abs(wrap_angle_np(afters[None, :, 2] - befores[:, None, 2] - turn))
    off_m = off_m / (_STEP_M + error * float(np.linalg.norm(driven_m)))
    off_rad = off_rad / (_STEP_RAD + error * abs(turn))
    return np.asarray(np.minimum(off_m**2 + off_rad**2, _MOST))


def _thinned(times_s: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean times and median poses over short times, with unwrapped headings."""
    psi = np.unwrap(poses[:, 2])
    groups = np.floor((times_s - times_s[0]) / _ANCHORS_APART_S).astype(int)
    rows = [np.flatnonzero(groups == group) for group in np.unique(groups)]
    return (
        np.array([times_s[row].mean() for row in rows]),
        np.array([[*np.median(poses[row, :2], axis=0), np.median(psi[row])] for row in rows]),
    )


def _bent(
    times_s: np.ndarray, driven: np.ndarray, anchor_s: np.ndarray, poses: np.ndarray
) -> np.ndarray:
    """(n, 3): the course by odometry, bent so that it goes through the anchors."""
    at = np.column_stack([np.interp(anchor_s, times_s, column) for column in driven.T])
    # Whole turns that only the odometry measured, between views, count too.
    psi = poses[:, 2] + 2 * np.pi * np.cumsum(
        np.round(np.diff(at[:, 2] - poses[:, 2], prepend=at[0, 2] - poses[0, 2]) / (2 * np.pi))
    )
    leg = np.clip(np.searchsorted(anchor_s, times_s, side="right") - 1, 0, len(anchor_s) - 1)
    following = np.minimum(leg + 1, len(anchor_s) - 1)

    def from_anchor(rows: np.ndarray) -> np.ndarray:
        turn = psi[rows] - at[rows, 2]
        moved = _turned(driven[:, :2] - at[rows, :2], turn)
        return np.column_stack([poses[rows, :2] + moved, driven[:, 2] + turn])

    span = np.maximum(anchor_s[following] - anchor_s[leg], 1e-9)
    share = np.clip((times_s - anchor_s[leg]) / span, 0.0, 1.0)[:, None]
    return np.asarray((1 - share) * from_anchor(leg) + share * from_anchor(following))


def _turned(vectors: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
