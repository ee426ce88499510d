"""PhotonVision's JSON of one camera at one resolution, as its calibration page exports and imports.

Snapshots of the board and results from them (`observations`) are in the same file.
"""

import json
from pathlib import Path
from typing import Annotated, Any

from pydantic import AliasChoices, Field, field_validator

from jaxnav.errors import BadInput
from jaxnav.files.figures import CameraFigures, unread_keys
from jaxnav.files.matrices import MatrixEntry, coefficients, figures_from_matrices, pinhole_matrix
from jaxnav.files.validation import ForeignEntry, Text, at, validate

_CV_64F = 6  # OpenCV's number for a matrix of doubles, the `type` of a matrix
_LENS_MODEL = "LENSMODEL_OPENCV"
_DISTORTION = ("distCoeffs", "cameraExtrinsics")
_Size = Annotated[float, Field(strict=True, ge=1, le=65536)]


class Resolution(ForeignEntry):
    """PhotonVision's image size."""

    width: _Size
    height: _Size

    @field_validator("width", "height")
    @classmethod
    def _whole(cls, value: float) -> float:
        if value != int(value):
            raise ValueError(f"must be a whole number of pixels, got {value:g}")
        return value


class PhotonVisionCamera(ForeignEntry):
    """PhotonVision's JSON of a camera; older versions wrote the lens under `cameraExtrinsics`."""

    resolution: Resolution
    cameraIntrinsics: MatrixEntry
    distCoeffs: Annotated[MatrixEntry, Field(validation_alias=AliasChoices(*_DISTORTION))]
    lensmodel: Text = _LENS_MODEL


def is_photonvision(data: dict[str, Any]) -> bool:
    """Whether a mapping looks like PhotonVision's camera."""
    return "cameraIntrinsics" in data


def photonvision_figures(path: Path, data: dict[str, Any], name: str) -> CameraFigures:
    """The camera of PhotonVision's JSON.

    Raises:
        BadInput: one line naming file and key.
    """
    stored = validate(PhotonVisionCamera, data, path)
    if "OPENCV" not in stored.lensmodel:
        problem = f"must be an OpenCV lens, got {stored.lensmodel!r}"
        raise BadInput(at(path, "lensmodel"), problem)
    return figures_from_matrices(
        name,
        (int(stored.resolution.width), int(stored.resolution.height)),
        (at(path, "cameraIntrinsics.data"), stored.cameraIntrinsics.data),
        (at(path, "distCoeffs.data"), stored.distCoeffs.data),
        "radtan",
    )


def photonvision_left_out(data: dict[str, Any]) -> list[str]:
    """The keys that are not read and not empty, see `unread_keys`."""
    return unread_keys(data, ["resolution", "cameraIntrinsics", "lensmodel", *_DISTORTION])


def photonvision_text(camera: CameraFigures) -> str:
    """The camera as PhotonVision's JSON, with no snapshots.

    Raises:
        BadInput: a fisheye lens, which PhotonVision does not know.
    """
    if camera.lens == "equidistant":
        raise BadInput(
            f"--to photonvision: {camera.name}.lens",
            "is equidistant, and PhotonVision knows radtan alone: calibrate again with radtan",
        )
    width, height = camera.image_size_px
    D = coefficients(camera)
    data = {
        "resolution": {"width": float(width), "height": float(height)},
        "cameraIntrinsics": _matrix(3, 3, pinhole_matrix(camera)),
        "distCoeffs": _matrix(1, len(D), D),
        "calobjectWarp": [0.0, 0.0],
        "observations": [],
        "calobjectSize": {"width": 0.0, "height": 0.0},
        "calobjectSpacing": 0.0,
        "lensmodel": _LENS_MODEL,
    }
    return json.dumps(data, indent=2) + "\n"


def _matrix(rows: int, cols: int, data: list[float]) -> dict[str, Any]:
    return {"rows": rows, "cols": cols, "type": _CV_64F, "data": data}
