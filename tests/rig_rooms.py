"""Build a room of markers and a path through it, for calibrations of a rig."""

import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.calibrate.rig.calibrate import RigCalibration
from jaxnav.calibrate.rig.views import RigViews, inverted
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.files import calib_dir, load_rig
from jaxnav.files.markers import marker_map
from jaxnav.files.poses import pose_from_matrix
from jaxnav.sim.sightings import simulate_sightings

SIZE_M = 0.172


def qcar() -> CameraRig:
    return load_rig(calib_dir() / "qcar" / "rig.yaml")


def room(markers: int = 8, seed: int = 0) -> np.ndarray:
    """(M, 4, 4) T_world_marker on the walls of a room of 4 x 3 m."""
    rng = np.random.default_rng(seed)
    Ts = []
    for index in range(markers):
        along, height = rng.uniform(-1.2, 1.2), rng.uniform(0.1, 0.5)
        x, y = [(2.0, along), (along, 1.5), (-2.0, along), (along, -1.5)][index % 4]
        normal = np.array([(-1, 0, 0), (0, -1, 0), (1, 0, 0), (0, 1, 0)][index % 4], float)
        up = np.array([0.0, 0, 1])
        T = np.eye(4)
        T[:3, :3] = np.stack([np.cross(up, normal), up, normal], axis=1)
        T[:3, 3] = x, y, height
        Ts.append(T)
    return np.stack(Ts)


def lemniscate(frames: int) -> np.ndarray:
    """(F, 4, 4) T_world_vehicle along a figure of eight on the floor."""
    t = np.linspace(0, 2 * np.pi, frames, endpoint=False)
    psi = np.arctan2(1.2 * np.cos(2 * t), np.cos(t))
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, 0, 0] = T[:, 1, 1] = np.cos(psi)
    T[:, 1, 0] = np.sin(psi)
    T[:, 0, 1] = -np.sin(psi)
    T[:, :2, 3] = np.stack([np.sin(t), 0.6 * np.sin(2 * t)], axis=1)
    return T


def as_map(Ts_world_marker: np.ndarray, size_m: float = SIZE_M) -> MarkerMap:
    count = len(Ts_world_marker)
    poses = np.stack([pose_from_matrix(T) for T in Ts_world_marker])
    return marker_map(poses, [size_m] * count, list(range(count)), ["tag36h11"] * count)


def views_of(
    rig: CameraRig,
    Ts_world_marker: np.ndarray,
    Ts_world_vehicle: np.ndarray,
    noise_px: float,
    seed: int,
) -> RigViews:
    poses = np.stack([pose_from_matrix(T) for T in Ts_world_vehicle])
    seen = simulate_sightings(
        rig, as_map(Ts_world_marker), poses, noise_px, np.random.default_rng(seed)
    )
    count = len(Ts_world_marker)
    return RigViews(
        *seen,
        size_m=np.full(count, SIZE_M),
        marker_ids=tuple(range(count)),
        stamps_ns=np.arange(len(Ts_world_vehicle)) * 33_333_333,
    )


def spoiled(rig: CameraRig, seed: int, m: float = 0.05, deg: float = 5.0) -> CameraRig:
    """The rig with every camera's place off by so much, in a direction of its own."""
    rng = np.random.default_rng(seed)
    twists = rng.normal(size=(len(rig), 2, 3))
    twists *= np.array([m, np.deg2rad(deg)])[None, :, None] / np.linalg.norm(
        twists, axis=2, keepdims=True
    )
    Ts = [
        jaxlie.SE3(wxyz_xyz) @ jaxlie.SE3.exp(jnp.asarray(twist.ravel()))
        for wxyz_xyz, twist in zip(rig.Ts_camera_vehicle.wxyz_xyz, twists, strict=True)
    ]
    stacked = jaxlie.SE3(jnp.stack([T.wxyz_xyz for T in Ts]))
    return CameraRig(rig.cameras, stacked, rig.names, rig.image_sizes_px)


def twists_to(Ts: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(n, 6) xi in T * cay(xi) = true, of small ones."""
    apart = inverted(Ts) @ true
    turn = np.stack(
        [
            apart[:, 2, 1] - apart[:, 1, 2],
            apart[:, 0, 2] - apart[:, 2, 0],
            apart[:, 1, 0] - apart[:, 0, 1],
        ],
        axis=1,
    )
    return np.concatenate([apart[:, :3, 3], turn / 2], axis=1)


def nees(found: RigCalibration, xi: np.ndarray, rows: np.ndarray) -> tuple[float, int]:
    """Normalised squared error of the rows (of 6 (C + M)) that have a variance, and its dof."""
    rows = rows[np.diag(found.covariance)[rows] > 0]
    P = found.covariance[np.ix_(rows, rows)]
    # A gauge may have taken directions away.
    values, vectors = np.linalg.eigh(P)
    kept = values > 1e-9 * values.max()
    e = vectors[:, kept].T @ xi.ravel()[rows]
    return float(np.sum(e**2 / values[kept])), int(kept.sum())
