"""Reading and writing camera rigs in jaxnav's own YAML.

    cameras:
      - name: front
        lens: equidistant                # none, radtan, rational, thin_prism, equidistant,
                                         # omni, double_sphere or eucm, see models/camera
        focal_px: [319.0, 319.0]
        center_px: [401.0, 202.0]        # the centre of the top-left pixel is (0, 0)
        distortion: [0.0, 0.0, 0.0, 0.0] # may be left out: zeros
        image_size_px: [820, 410]        # width, height
        position_m: [0.193, 0.0, 0.0953] # in the vehicle frame, with yaw_deg (0 forward, 90 left),
        yaw_deg: 0.0                     # elevation_deg (up) and roll_deg (clockwise from behind)

A camera may have the times of its sensor, by which blurred markers are followed: `exposure_s`, and
`row_time_s` from the exposure of one row to that of the next (0 for a global shutter). What a
driver says of a frame goes before them, and where neither does, the exposure is learnt.

The place of a camera may also be `T_vehicle_camera` or its inverse `T_camera_vehicle`, each
either 4x4 or `{wxyz: [...], xyz_m: [...]}`. A camera may have standard deviations (`sigma`): those
of its place (`position_m`, `rotation_deg`) are what the estimator allows for: where the file does
not say, 5 mm and 0.5 degrees, and for a camchain, which was calibrated, 2 mm and 0.2 degrees. The
file may have a provenance (`calibrated`, see `jaxnav.files.provenance`).
"""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float
from pydantic import Field, field_validator, model_validator

from jaxnav.core.models.camera import LENS_COEFFICIENTS, Camera
from jaxnav.core.models.lenses import LENSES
from jaxnav.core.models.rig import PLACED_BY_HAND, UNKNOWN_TIMING, CameraRig, Timing
from jaxnav.core.parameters import TUNABLES
from jaxnav.errors import BadInput
from jaxnav.files import poses
from jaxnav.files.provenance import Calibrated, file_text
from jaxnav.files.ranges import Range, pinhole_problem, within
from jaxnav.files.reading import first_repeated
from jaxnav.files.validation import (
    NAME_PATTERN,
    AngleDeg,
    Coefficient,
    Entry,
    ImageSize,
    Mount,
    MountPose,
    Name,
    Number,
    Pair,
    Positive,
    PositivePair,
    QuaternionPose,
    Wrong,
)
from jaxnav.files.writing import atomic_write

Lens = Literal[
    "none", "radtan", "rational", "thin_prism", "equidistant", "omni", "double_sphere", "eucm"
]
# One that is larger says that nobody knows where the camera is, or was written in another unit.
_MOST_SIGMA_M, *_, _MOST_SIGMA_RAD = TUNABLES["rig.extrinsics_sigma"].most
_MOST_SIGMA_DEG = round(math.degrees(_MOST_SIGMA_RAD), 9)
SigmaM = Annotated[Number, Field(ge=0, le=_MOST_SIGMA_M)]
SigmaDeg = Annotated[Number, Field(ge=0, le=_MOST_SIGMA_DEG)]
_Three = Field(min_length=3, max_length=3)


class CameraSigma(Entry):
    """One standard deviation of each figure of a camera."""

    focal_px: Pair | None = None
    center_px: Pair | None = None
    distortion: list[Number] | None = None
    # Of the camera, along the axes of the vehicle and about them.
    position_m: Annotated[list[SigmaM], _Three] | None = None
    rotation_deg: Annotated[list[SigmaDeg], _Three] | None = None

    @model_validator(mode="after")
    def _of_a_whole_place(self) -> "CameraSigma":
        if (self.position_m is None) != (self.rotation_deg is None):
            missing = "position_m" if self.position_m is None else "rotation_deg"
            raise ValueError(f"{missing} is missing: it goes with the other sigma of a place")
        return self

    @staticmethod
    def from_place(sigma: Float[np.ndarray, " 6"]) -> "CameraSigma":
        """Those of a place, m, and of a direction, rad."""
        turn_deg = np.minimum(np.rad2deg(sigma[3:]), _MOST_SIGMA_DEG)  # once rounded
        return CameraSigma.model_construct(
            position_m=sigma[:3].tolist(), rotation_deg=turn_deg.tolist()
        )

    def place(self) -> Float[np.ndarray, " 6"]:
        """Sigmas of the place, m, and of the direction, rad; measured by hand if not given."""
        if self.position_m is None or self.rotation_deg is None:
            return PLACED_BY_HAND
        return np.concatenate([self.position_m, np.deg2rad(self.rotation_deg)])

    def lens_px(self) -> Float[np.ndarray, " 4"] | None:
        """Sigmas of fx, fy, cx, cy, px; None where they are not given."""
        if self.focal_px is None or self.center_px is None:
            return None
        return np.array([*self.focal_px, *self.center_px])


class CameraEntry(Entry):
    """One camera of a rig file, and of every other tool's file once it is read.

    Its numbers are float64, whatever JAX's precision is: so what two formats hold goes from one to
    the other bit for bit.
    """

    name: Name
    lens: Lens
    focal_px: PositivePair
    center_px: Pair
    distortion: list[Coefficient] = Field(default_factory=list)
    image_size_px: ImageSize
    exposure_s: Annotated[Positive, within("exposure_s")] | None = None
    row_time_s: Annotated[Number, within("row_time_s")] | None = None
    T_vehicle_camera: MountPose | None = None
    T_camera_vehicle: MountPose | None = None
    position_m: Mount | None = None
    yaw_deg: AngleDeg | None = None
    elevation_deg: AngleDeg | None = None
    roll_deg: AngleDeg | None = None
    sigma: CameraSigma | None = None

    @model_validator(mode="after")
    def _agrees(self) -> "CameraEntry":
        lens, count, most = self.lens, len(self.distortion), LENS_COEFFICIENTS[self.lens]
        allowed = {0, most, 4} if lens == "radtan" else {0, most}
        if count not in allowed:
            expected = " or ".join(str(count) for count in sorted(allowed - {0}) or [0])
            problem = f"must have {expected} coefficients for the lens {lens}, got {count}"
            raise Wrong("distortion", problem)
        if wrong := coefficients_problem(lens, self.distortion):
            raise Wrong("distortion", wrong)
        places = ("T_vehicle_camera", "T_camera_vehicle", "position_m")
        given = [key for key in places if getattr(self, key) is not None]
        if len(given) != 1:
            ending = f"got {' and '.join(given)}" if given else "got none"
            raise ValueError(f"needs exactly one of {', '.join(places)}, {ending}")
        angles = [key for key in ("yaw_deg", "elevation_deg", "roll_deg") if getattr(self, key)]
        if angles and given != ["position_m"]:
            raise ValueError(f"{angles[0]} goes with position_m, not with {given[0]}")
        if given == ["position_m"] and self.yaw_deg is None:
            raise ValueError("position_m needs yaw_deg (0 looks forward, 90 to the left)")
        if wrong := pinhole_problem([*self.focal_px, *self.center_px], self.image_size_px):
            raise ValueError(f"focal_px, center_px, image_size_px: {wrong}")
        return self

    @staticmethod
    def create(
        name: str,
        lens: Lens,
        pinhole_px: Sequence[float],
        distortion: Sequence[float],
        image_size_px: Sequence[int],
        **more: Any,
    ) -> "CameraEntry":
        """A camera whose numbers have been checked already; it may have any name, and no place.

        Args:
            pinhole_px: fx fy cx cy.
            distortion: missing last coefficients are zero.
            more: other fields.
        """
        missing = [0.0] * (LENS_COEFFICIENTS[lens] - len(distortion))
        return CameraEntry.model_construct(
            name=name,
            lens=lens,
            focal_px=[float(value) for value in pinhole_px[:2]],
            center_px=[float(value) for value in pinhole_px[2:]],
            distortion=[*(float(value) for value in distortion), *missing],
            image_size_px=[int(side) for side in image_size_px],
            **more,
        )

    def placed(self) -> "CameraEntry":
        """The same camera, with all coefficients, and with `T_camera_vehicle` for its place."""
        T_camera_vehicle = self.T_camera_vehicle
        if self.T_vehicle_camera is not None:
            T_camera_vehicle = pose_entry(poses.inverse(poses.pose_as_read(self.T_vehicle_camera)))
        elif self.position_m is not None:
            angles_deg = (self.yaw_deg or 0.0, self.elevation_deg or 0.0, self.roll_deg or 0.0)
            T_camera_vehicle = place(self.position_m, angles_deg)
        return CameraEntry.create(
            self.name,
            self.lens,
            [*self.focal_px, *self.center_px],
            self.distortion,
            self.image_size_px,
            T_camera_vehicle=T_camera_vehicle,
            sigma=self.sigma,
            **self.timing._asdict(),
        )

    def camera(self) -> Camera:
        """The camera without its place, in the process's precision."""
        return Camera.create(self.focal_px, self.center_px, self.lens, self.distortion)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of its images."""
        width, height = self.image_size_px
        return width, height

    @property
    def timing(self) -> Timing:
        """When its sensor sees."""
        return Timing(self.exposure_s, self.row_time_s)


def coefficients_problem(lens: str, coefficients: Sequence[float]) -> str | None:
    """What is wrong with a lens's coefficients, in its order; None where nothing is."""
    kind = LENSES[lens]
    for name, value in zip(kind.coefficients, coefficients, strict=False):
        least, most = kind.within.get(name, (-math.inf, math.inf))
        if not Range(least, most, "", name).holds(value):
            allowed = f"from {least:g} to {most:g}" if most < math.inf else f"at least {least:g}"
            return f"{name} of the lens {lens} must be {allowed}, got {value:g}"
    return None


class RigFile(Entry):
    """A rig file."""

    cameras: Annotated[list[CameraEntry], Field(min_length=1, max_length=64)]
    calibrated: Calibrated | None = None

    @field_validator("cameras")
    @classmethod
    def _names_differ(cls, cameras: list[CameraEntry]) -> list[CameraEntry]:
        if twice := first_repeated(camera.name for camera in cameras):
            raise ValueError(f"the name {twice!r} is used twice")
        return cameras

    def rig(self) -> CameraRig:
        """The rig, in the process's precision."""
        return rig_of([entry.placed() for entry in self.cameras])


def rig_of(cameras: Sequence[CameraEntry]) -> CameraRig:
    """The rig of cameras that all have `T_camera_vehicle`, in the process's precision."""
    sigmas = np.stack([(camera.sigma or CameraSigma()).place() for camera in cameras])
    timings = [camera.timing for camera in cameras]
    Ts = [poses.pose_as_read(camera.T_camera_vehicle) for camera in cameras]
    return CameraRig.create(
        [camera.camera() for camera in cameras],
        [jaxlie.SE3(jnp.asarray(T, float)) for T in Ts],
        [camera.name for camera in cameras],
        [camera.size_px for camera in cameras],
        # Degrees and radians give back the same numbers where these are float32's.
        np.asarray(sigmas, np.float32).astype(float) if sigmas.any() else None,
        timings if any(timing != UNKNOWN_TIMING for timing in timings) else None,
    )


def save_rig(
    path: str | Path,
    rig: CameraRig,
    calibrated: Calibrated | None = None,
    sigmas: Sequence[CameraSigma] | None = None,
) -> None:
    """Write a rig in jaxnav's own YAML; `load_rig` gives back the same numbers, bit for bit.

    Args:
        calibrated: the provenance of the figures.
        sigmas: one entry for each camera.

    Raises:
        BadInput: the file can't be written.
    """
    data = rig_data(rig)
    for entry, sigma in zip(data["cameras"], sigmas or (), strict=bool(sigmas)):
        entry["sigma"] = entry.get("sigma", {}) | sigma.model_dump(exclude_none=True)
    atomic_write(path, file_text(data, calibrated))


def rig_data(rig: CameraRig) -> dict[str, Any]:
    """The content of a rig's file in plain values, all numbers bit for bit; see `RigFile`."""
    entries = []
    for index, name in enumerate(rig.names):
        camera = rig.camera(index)
        lens: Any = rig.cameras.lenses[int(camera.lens_index)]
        T_camera_vehicle = np.asarray(rig.Ts_camera_vehicle.wxyz_xyz[index], float)
        known = rig.extrinsics_sigma
        sigma = np.zeros(6) if known is None else np.asarray(known[index], float)
        entries.append(
            CameraEntry.create(
                name,
                lens,
                np.concatenate([camera.focal_px, camera.center_px]).tolist(),
                np.asarray(camera.distortion)[: LENS_COEFFICIENTS[lens]].tolist(),
                rig.image_sizes_px[index],
                T_camera_vehicle=pose_entry(T_camera_vehicle),
                sigma=CameraSigma.from_place(sigma),
                **rig.timing(index)._asdict(),
            )
        )
    return _file_data(entries)


def _file_data(cameras: Sequence[CameraEntry]) -> dict[str, Any]:
    return {"cameras": [camera.model_dump(exclude_none=True) for camera in cameras]}


def rig_text(cameras: Sequence[CameraEntry]) -> str:
    """The cameras as the text of a rig file.

    Raises:
        BadInput: a camera has no place, or a name that a rig can't hold.
    """
    for camera in cameras:
        where = f"--to jaxnav: {camera.name}"
        if camera.T_camera_vehicle is None:
            problem = "has no place on the vehicle: give --position-m and --yaw-deg"
            if len(cameras) > 1:
                problem = "has no place on the vehicle: write T_cam_imu into the source"
            raise BadInput(where, problem)
        if not re.match(NAME_PATTERN, camera.name):
            raise BadInput(where, "can't be a camera's name (a letter first): give --camera-name")
    return file_text(_file_data(cameras))


def rig_left_out(file: RigFile) -> list[str]:
    """The names of the entries of a rig file that other formats don't hold."""
    left_out = ["calibrated"] if file.calibrated else []
    of_lens = {"focal_px", "center_px", "distortion"}
    for entry in file.cameras:
        if entry.sigma and entry.sigma.model_dump(include=of_lens, exclude_none=True):
            left_out.append(f"cameras.{entry.name}.sigma")
    return left_out


def place(position_m: Sequence[float], angles_deg: Sequence[float]) -> QuaternionPose:
    """The pose T_camera_vehicle of a camera by its position and direction.

    Args:
        position_m: of the camera in the vehicle.
        angles_deg: yaw, elevation and roll, see `poses.rotation_towards`.
    """
    T_vehicle_camera = poses.transform(poses.rotation_towards(*angles_deg), position_m)
    return pose_entry(poses.inverse(poses.pose_from_matrix(T_vehicle_camera)))


def pose_entry(pose: Float[np.ndarray, " 7"]) -> QuaternionPose:
    """A pose (7,) wxyz_xyz as files hold it."""
    return QuaternionPose.model_construct(wxyz=pose[:4].tolist(), xyz_m=pose[4:].tolist())
