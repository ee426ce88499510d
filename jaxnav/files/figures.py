"""The figures of a camera and of a marker as files hold them: float64, whatever JAX's precision is.

Every reader of camera files makes these and every writer takes them; from files, a `Camera` or a
`CameraRig` is made only of them. So a figure that two formats hold goes from one to the other bit
for bit.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float

from jaxnav.core.models.camera import LENS_COEFFICIENTS, Camera
from jaxnav.core.models.lenses import LENSES
from jaxnav.core.models.rig import PLACED_BY_HAND, UNKNOWN_TIMING, CameraRig, Timing
from jaxnav.files import poses
from jaxnav.files.ranges import Range

Lens = Literal[
    "none",
    "radtan",
    "rational",
    "thin_prism",
    "equidistant",
    "omni",
    "double_sphere",
    "eucm",
]


@dataclass(frozen=True, eq=False)
class CameraFigures:
    """The figures of one camera.

    Attributes:
        lens: see `jaxnav.core.models.camera`.
        focal_px: fx, fy.
        center_px: cx, cy; the centre of the top-left pixel is (0, 0).
        distortion: all coefficients of the lens, in its order.
        image_size_px: width, height.
        T_camera_vehicle: a pose as it is written, (7,) or (4, 4), see `jaxnav.files.poses`; None
            where the file does not place the camera.
        sigma: (6,) of its place along the vehicle's axes, m, and of its direction about them, rad;
            None where the file does not say.
        lens_sigma_px: (4,) of fx, fy, cx, cy; None where the file does not say. Read only: no file
            is given it.
        timing: of its sensor.
    """

    name: str
    lens: Lens
    focal_px: tuple[float, float]
    center_px: tuple[float, float]
    distortion: tuple[float, ...]
    image_size_px: tuple[int, int]
    T_camera_vehicle: Float[np.ndarray, " 7"] | Float[np.ndarray, "4 4"] | None = None
    sigma: Float[np.ndarray, " 6"] | None = None
    lens_sigma_px: Float[np.ndarray, " 4"] | None = None
    timing: Timing = UNKNOWN_TIMING

    @staticmethod
    def create(
        name: str,
        lens: Lens,
        pinhole_px: Sequence[float],
        distortion: Sequence[float],
        image_size_px: Sequence[int],
        T_camera_vehicle: Float[np.ndarray, " 7"] | Float[np.ndarray, "4 4"] | None = None,
        sigma: Float[np.ndarray, " 6"] | None = None,
        lens_sigma_px: Float[np.ndarray, " 4"] | None = None,
        timing: Timing = UNKNOWN_TIMING,
    ) -> "CameraFigures":
        """A camera from fx fy cx cy and coefficients; missing last coefficients are zero."""
        fx, fy, cx, cy = (float(value) for value in pinhole_px)
        missing = LENS_COEFFICIENTS[lens] - len(distortion)
        return CameraFigures(
            name=name,
            lens=lens,
            focal_px=(fx, fy),
            center_px=(cx, cy),
            distortion=(*(float(value) for value in distortion), *(0.0,) * missing),
            image_size_px=(int(image_size_px[0]), int(image_size_px[1])),
            T_camera_vehicle=T_camera_vehicle,
            sigma=sigma,
            lens_sigma_px=lens_sigma_px,
            timing=timing,
        )

    def camera(self) -> Camera:
        """The camera without its place, in the process's precision."""
        return Camera.create(self.focal_px, self.center_px, self.lens, self.distortion)


def coefficients_problem(lens: str, coefficients: Sequence[float]) -> str | None:
    """What is wrong with a lens's coefficients, in its order; None where nothing is."""
    kind = LENSES[lens]
    for name, value in zip(kind.coefficients, coefficients, strict=False):
        least, most = kind.within.get(name, (-math.inf, math.inf))
        if not Range(least, most, "", name).holds(value):
            allowed = f"from {least:g} to {most:g}" if most < math.inf else f"at least {least:g}"
            return f"{name} of the lens {lens} must be {allowed}, got {value:g}"
    return None


@dataclass(frozen=True, eq=False)
class MarkerFigures:
    """The figures of one marker of a map.

    Attributes:
        T_world_marker: a pose as it is written, (7,) or (4, 4).
    """

    id: int
    family: str
    size_m: float
    T_world_marker: Float[np.ndarray, " 7"] | Float[np.ndarray, "4 4"]


def rig_from_figures(cameras: Sequence[CameraFigures]) -> CameraRig:
    """The rig of some cameras, in the process's precision; every camera must have a place.

    A place without standard deviations has those of one measured by hand.
    """
    Ts_camera_vehicle = []
    timings = [camera.timing for camera in cameras]
    for camera in cameras:
        assert camera.T_camera_vehicle is not None
        Ts_camera_vehicle.append(to_se3(poses.pose_as_read(camera.T_camera_vehicle)))
    return CameraRig.create(
        [camera.camera() for camera in cameras],
        Ts_camera_vehicle,
        [camera.name for camera in cameras],
        [camera.image_size_px for camera in cameras],
        _sigmas(cameras),
        timings if any(timing != UNKNOWN_TIMING for timing in timings) else None,
    )


def _sigmas(cameras: Sequence[CameraFigures]) -> Float[np.ndarray, "C 6"] | None:
    """The standard deviations of the cameras' places; None where all are 0."""
    sigmas = np.stack([PLACED_BY_HAND if c.sigma is None else c.sigma for c in cameras])
    # Degrees and radians give back the same numbers where these are float32's.
    return np.asarray(sigmas, np.float32).astype(float) if sigmas.any() else None


def figures_of_rig(rig: CameraRig) -> list[CameraFigures]:
    """The figures of a rig, bit for bit."""
    figures = []
    for index, name in enumerate(rig.names):
        camera = rig.camera(index)
        lens: Any = rig.cameras.lenses[int(camera.lens_index)]
        known = rig.extrinsics_sigma
        sigma = np.zeros(6) if known is None else np.asarray(known[index], float)
        figures.append(
            CameraFigures.create(
                name,
                lens,
                np.concatenate([camera.focal_px, camera.center_px]).tolist(),
                np.asarray(camera.distortion)[: LENS_COEFFICIENTS[lens]].tolist(),
                rig.image_sizes_px[index],
                np.asarray(rig.Ts_camera_vehicle.wxyz_xyz[index], float),
                sigma,
                timing=rig.timing(index),
            )
        )
    return figures


def to_se3(pose: Float[np.ndarray, " 7"]) -> jaxlie.SE3:
    """A pose (7,) as jaxlie's, in the process's precision."""
    return jaxlie.SE3(jnp.asarray(pose, float))


def unread_keys(data: Mapping[str, Any], known: Sequence[str], prefix: str = "") -> list[str]:
    """The keys of a file, except the known ones, whose values are not empty, zero or false."""
    unread = []
    for key, value in data.items():
        if key not in known and _says_something(value):
            count = f" ({len(value)} entries)" if isinstance(value, list) else ""
            unread.append(f"{prefix}{key if key.isprintable() else ascii(key)}{count}")
    return unread


def _says_something(value: Any, levels: int = 8) -> bool:
    inner = list(value.values()) if isinstance(value, Mapping) else value
    if isinstance(inner, list) and levels:
        return any(_says_something(item, levels - 1) for item in inner)
    return bool(inner)
