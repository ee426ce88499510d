"""Kalibr's camchain YAML, with imu := vehicle.

`T_cam_imu` maps vehicle to camera. A camera without one is chained from the camera before it by
`T_cn_cnm1`; OpenVINS's inverse, `T_imu_cam`, is read too.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from jaxnav.camera import Camera
from jaxnav.errors import BadInput
from jaxnav.files import poses
from jaxnav.files.reading import read_mapping
from jaxnav.files.validation import (
    ForeignEntry,
    ImageSize,
    Matrix,
    Number,
    Text,
    at,
    validate,
)

_LENS = {"radtan": "radtan", "equidistant": "equidistant", "equi": "equidistant", "none": "none"}
_CAMERA_KEY = re.compile(r"cam(0|[1-9][0-9]?)")


class KalibrCamera(ForeignEntry):
    """One `camN` of a camchain."""

    camera_model: Text
    intrinsics: list[Number]
    distortion_model: Text = "none"
    distortion_coeffs: list[Number] = Field(default_factory=list)
    resolution: ImageSize
    T_cam_imu: Matrix | None = None
    T_imu_cam: Matrix | None = None
    T_cn_cnm1: Matrix | None = None
    tagtopic: Text | None = None  # TagSLAM's: where the detections of this camera are published
    rig_body: Text | None = None  # TagSLAM's: the body that carries it

    @field_validator("camera_model")
    @classmethod
    def _pinhole(cls, model: str) -> str:
        if model != "pinhole":
            raise ValueError(
                f"must be 'pinhole', got {model!r}: calibrate with pinhole-radtan or pinhole-equi"
            )
        return model

    @field_validator("intrinsics")
    @classmethod
    def _fu_fv_pu_pv(cls, intrinsics: list[float]) -> list[float]:
        if len(intrinsics) != 4:
            raise ValueError(f"must be fu fv pu pv, got {len(intrinsics)} numbers")
        if min(intrinsics[:2]) < 1e-6:
            raise ValueError(f"the focal lengths must be > 0, got {intrinsics[:2]}")
        return intrinsics

    @field_validator("distortion_model")
    @classmethod
    def _known_lens(cls, model: str) -> str:
        if model not in _LENS:
            raise ValueError(f"must be one of {', '.join(_LENS)}, got {model!r}")
        return model

    @field_validator("distortion_coeffs")
    @classmethod
    def _four(cls, coefficients: list[float], info: Any) -> list[float]:
        # Kalibr writes four for both lenses; for `none` some tools write zeros.
        model = info.data.get("distortion_model", "none")
        if model == "none" and any(coefficients):
            raise ValueError("must be empty for distortion_model none")
        if model != "none" and len(coefficients) != 4:
            raise ValueError(f"must have 4 numbers, got {len(coefficients)}")
        return coefficients

    def camera(self) -> Camera:
        """The intrinsic part."""
        lens = _LENS[self.distortion_model]
        coefficients = () if lens == "none" else self.distortion_coeffs
        return Camera.create(self.intrinsics[:2], self.intrinsics[2:], lens, coefficients)


def is_camchain(data: dict[str, Any]) -> bool:
    """Whether a mapping looks like a camchain."""
    return any(_CAMERA_KEY.fullmatch(key) for key in data)


def camchain(path: Path, data: dict[str, Any] | None = None) -> dict[str, KalibrCamera]:
    """The cameras of a camchain file in the order of their numbers.

    Raises:
        BadInput: one line naming file and key.
    """
    data = read_mapping(path) if data is None else data
    keys = sorted((key for key in data if _CAMERA_KEY.fullmatch(key)), key=lambda k: int(k[3:]))
    if not keys:
        raise BadInput(path, "has no camera (`cam0:`)")
    for number, key in enumerate(keys):
        if key != f"cam{number}":
            raise BadInput(at(path, f"cam{number}"), f"missing, though there is {keys[-1]}")
    return {key: validate(KalibrCamera, data[key], path, key) for key in keys}


def Ts_camera_imu(path: Path, chain: dict[str, KalibrCamera]) -> list[np.ndarray]:
    """(7,) wxyz_xyz for every camera: the IMU (the vehicle) in the camera.

    Raises:
        BadInput: a camera whose place is not given.
    """
    Ts: list[np.ndarray] = []
    for key, entry in chain.items():
        if entry.T_cam_imu is not None:
            Ts.append(poses.pose_from_matrix(entry.T_cam_imu))
        elif entry.T_imu_cam is not None:
            Ts.append(poses.inverse(poses.pose_from_matrix(entry.T_imu_cam)))
        elif entry.T_cn_cnm1 is not None and Ts:
            Ts.append(poses.compose(poses.pose_from_matrix(entry.T_cn_cnm1), Ts[-1]))
        else:
            problem = "missing: where is this camera on the vehicle (imu := vehicle)?"
            raise BadInput(at(path, key, "T_cam_imu"), problem)
    return Ts
