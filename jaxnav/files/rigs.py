"""Camera rigs: jaxnav's own YAML, in and out.

    cameras:
      - name: front
        lens: equidistant                # none, radtan (k1 k2 p1 p2 [k3]) or equidistant (k1..k4)
        focal_px: [319.0, 319.0]
        center_px: [401.0, 202.0]        # the centre of the top-left pixel is (0, 0)
        distortion: [0.0, 0.0, 0.0, 0.0] # may be left out: zeros
        image_size_px: [820, 410]        # width, height
        position_m: [0.193, 0.0, 0.0953] # in the vehicle frame, with yaw_deg (0 forward, 90 left),
        yaw_deg: 0.0                     # elevation_deg (up) and roll_deg (clockwise from behind)

The place of a camera may also be `T_vehicle_camera` or its inverse `T_camera_vehicle`, each
either 4x4 or `{wxyz: [...], xyz_m: [...]}`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import jax.numpy as jnp
import jaxlie
import numpy as np
import yaml
from pydantic import Field, field_validator, model_validator

from jaxnav.camera import LENS_COEFFICIENTS, Camera
from jaxnav.errors import BadInput
from jaxnav.files import kalibr, poses
from jaxnav.files.reading import read_mapping
from jaxnav.files.validation import (
    Entry,
    ImageSize,
    Name,
    Number,
    Pair,
    Point,
    Pose,
    PositivePair,
    QuaternionPose,
    validate,
)
from jaxnav.files.writing import atomic_write
from jaxnav.rig import CameraRig

Lens = Literal["none", "radtan", "equidistant"]


class CameraEntry(Entry):
    """One camera of a rig file."""

    name: Name
    lens: Lens
    focal_px: PositivePair
    center_px: Pair
    distortion: list[Number] = Field(default_factory=list)
    image_size_px: ImageSize
    T_vehicle_camera: Pose | None = None
    T_camera_vehicle: Pose | None = None
    position_m: Point | None = None
    yaw_deg: Number | None = None
    elevation_deg: Number | None = None
    roll_deg: Number | None = None

    @field_validator("distortion")
    @classmethod
    def _as_the_lens_counts(cls, coefficients: list[float], info: Any) -> list[float]:
        lens = info.data.get("lens", "none")
        most = LENS_COEFFICIENTS[lens]
        allowed = {0, most, 4} if lens == "radtan" else {0, most}
        if len(coefficients) not in allowed:
            expected = " or ".join(str(count) for count in sorted(allowed - {0}) or [0])
            raise ValueError(
                f"must have {expected} coefficients for the lens {lens}, got {len(coefficients)}"
            )
        return coefficients

    @model_validator(mode="after")
    def _placed_once(self) -> "CameraEntry":
        places = ("T_vehicle_camera", "T_camera_vehicle", "position_m")
        given = [key for key in places if getattr(self, key) is not None]
        if len(given) != 1:
            found = f"got {' and '.join(given)}" if given else "got none"
            raise ValueError(f"needs exactly one of {', '.join(places)}, {found}")
        angles = [key for key in ("yaw_deg", "elevation_deg", "roll_deg") if getattr(self, key)]
        if angles and given != ["position_m"]:
            raise ValueError(f"{angles[0]} goes with position_m, not with {given[0]}")
        if given == ["position_m"] and self.yaw_deg is None:
            raise ValueError("position_m needs yaw_deg (0 looks forward, 90 to the left)")
        return self

    def camera(self) -> Camera:
        """The intrinsic part."""
        return Camera.create(self.focal_px, self.center_px, self.lens, self.distortion)

    def T_camera_vehicle_pose(self) -> np.ndarray:
        """(7,) wxyz_xyz of the vehicle in the camera."""
        if self.T_camera_vehicle is not None:
            return pose_array(self.T_camera_vehicle)
        if self.T_vehicle_camera is not None:
            return poses.inverse(pose_array(self.T_vehicle_camera))
        T_vehicle_camera = np.eye(4)
        T_vehicle_camera[:3, :3] = poses.looking(
            self.yaw_deg or 0.0, self.elevation_deg or 0.0, self.roll_deg or 0.0
        )
        T_vehicle_camera[:3, 3] = self.position_m
        return poses.inverse(poses.pose_from_matrix(T_vehicle_camera))


class RigFile(Entry):
    """A rig file."""

    cameras: Annotated[list[CameraEntry], Field(min_length=1, max_length=64)]

    @field_validator("cameras")
    @classmethod
    def _names_differ(cls, cameras: list[CameraEntry]) -> list[CameraEntry]:
        names = [camera.name for camera in cameras]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"the name {twice!r} is used twice")
        return cameras

    def rig(self) -> CameraRig:
        """The rig, in the process's precision."""
        return CameraRig.create(
            [entry.camera() for entry in self.cameras],
            [to_se3(entry.T_camera_vehicle_pose()) for entry in self.cameras],
            [entry.name for entry in self.cameras],
            [(entry.image_size_px[0], entry.image_size_px[1]) for entry in self.cameras],
        )


def load_rig(path: str | Path) -> CameraRig:
    """A camera rig from jaxnav's own YAML, or from a Kalibr camchain with imu := vehicle.

    Raises:
        BadInput: one line naming file and key.
    """
    path = Path(path)
    data = read_mapping(path)
    if "cameras" in data:
        return validate(RigFile, data, path).rig()
    if kalibr.is_camchain(data):
        chain = kalibr.camchain(path, data)
        return CameraRig.create(
            [entry.camera() for entry in chain.values()],
            [to_se3(pose) for pose in kalibr.Ts_camera_imu(path, chain)],
            [entry.tagtopic or name for name, entry in chain.items()],
            [(entry.resolution[0], entry.resolution[1]) for entry in chain.values()],
        )
    raise BadInput(path, "is neither a rig (`cameras:`) nor a Kalibr camchain (`cam0:`)")


def save_rig(path: str | Path, rig: CameraRig) -> None:
    """Write a rig in jaxnav's own YAML; `load_rig` gives back the same numbers, bit for bit.

    Raises:
        BadInput: the file can't be written.
    """
    atomic_write(path, yaml_text(rig_data(rig)))


def rig_data(rig: CameraRig) -> dict[str, Any]:
    """What a file of the rig holds, in plain values, all numbers bit for bit; see `RigFile`."""
    entries: list[dict[str, Any]] = []
    for index, name in enumerate(rig.names):
        camera = rig.camera(index)
        lens = rig.cameras.lenses[int(camera.lens_index)]
        entries.append(
            {
                "name": name,
                "lens": lens,
                "focal_px": plain(camera.focal_px),
                "center_px": plain(camera.center_px),
                "distortion": plain(camera.distortion[: LENS_COEFFICIENTS[lens]]),
                "image_size_px": list(rig.image_sizes_px[index]),
                "T_camera_vehicle": plain_pose(rig.Ts_camera_vehicle.wxyz_xyz[index]),
            }
        )
    return {"cameras": entries}


def pose_array(pose: QuaternionPose | Sequence[Sequence[float]]) -> np.ndarray:
    """(7,) wxyz_xyz of a pose in either of its forms."""
    if isinstance(pose, QuaternionPose):
        return poses.pose_from_quaternion(pose.wxyz, pose.xyz_m)
    return poses.pose_from_matrix(pose)


def plain_pose(wxyz_xyz: Any) -> dict[str, list[float]]:
    """A pose as we write it."""
    return {"wxyz": plain(wxyz_xyz[:4]), "xyz_m": plain(wxyz_xyz[4:])}


def plain(values: Any) -> list[float]:
    """Numbers for YAML."""
    return [float(value) for value in np.asarray(values)]


def yaml_text(data: dict[str, Any]) -> str:
    """YAML with lists of numbers on one line each."""
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=200)


def to_se3(pose: np.ndarray) -> jaxlie.SE3:
    """A pose in the process's precision."""
    return jaxlie.SE3(jnp.asarray(pose, float))
