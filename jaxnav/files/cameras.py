"""One calibrated camera, from the files of whichever tool calibrated it.

Read: jaxnav's own rig YAML, Kalibr's camchain, ROS's camera_info YAML, OpenCV's FileStorage YAML
(as its calibration sample and most scripts write it) and PhotonVision's JSON.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import AliasChoices, Field, field_validator

from jaxnav.camera import LENSES, Camera
from jaxnav.errors import BadInput
from jaxnav.files import kalibr
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import RigFile
from jaxnav.files.validation import (
    Count,
    ForeignEntry,
    ImageSize,
    Number,
    Pixels,
    Text,
    at,
    validate,
)

ImageSizePx = tuple[int, int]  # width, height

_COEFFICIENTS = "k1 k2 p1 p2 k3"


class MatrixEntry(ForeignEntry):
    """A matrix as ROS, OpenCV and PhotonVision write it."""

    rows: Count
    cols: Count
    data: Annotated[list[Number], Field(max_length=64)]

    @field_validator("data")
    @classmethod
    def _complete(cls, data: list[float], info: Any) -> list[float]:
        rows, cols = info.data.get("rows"), info.data.get("cols")
        if rows is not None and cols is not None and rows * cols != len(data):
            raise ValueError(f"must have {rows} x {cols} numbers, got {len(data)}")
        return data


class CameraInfo(ForeignEntry):
    """ROS's camera_info YAML."""

    image_width: Pixels
    image_height: Pixels
    camera_matrix: MatrixEntry
    distortion_model: Text
    distortion_coefficients: MatrixEntry


class OpenCVCamera(ForeignEntry):
    """OpenCV's FileStorage, under the names of its samples and those of its Python functions."""

    image_width: Pixels | None = None
    image_height: Pixels | None = None
    image_size: Annotated[
        ImageSize | None, Field(validation_alias=AliasChoices("image_size", "imageSize"))
    ] = None
    camera_matrix: Annotated[
        MatrixEntry, Field(validation_alias=AliasChoices("camera_matrix", "cameraMatrix", "K"))
    ]
    distortion_coefficients: Annotated[
        MatrixEntry,
        Field(validation_alias=AliasChoices("distortion_coefficients", "distCoeffs", "D")),
    ]
    fisheye_model: Annotated[int, Field(strict=True, ge=0, le=1)] = 0


class Resolution(ForeignEntry):
    """PhotonVision's image size."""

    width: Annotated[float, Field(strict=True, ge=1, le=65536)]
    height: Annotated[float, Field(strict=True, ge=1, le=65536)]


class PhotonVisionCamera(ForeignEntry):
    """PhotonVision's JSON. Older versions wrote the lens under `cameraExtrinsics`."""

    resolution: Resolution
    cameraIntrinsics: MatrixEntry
    distCoeffs: Annotated[
        MatrixEntry, Field(validation_alias=AliasChoices("distCoeffs", "cameraExtrinsics"))
    ]
    lensmodel: Text = "LENSMODEL_OPENCV"


def load_camera(path: str | Path, name: str | None = None) -> tuple[Camera, ImageSizePx]:
    """One camera and the size of its images in pixels (width, height).

    Args:
        path: a calibration file.
        name: which camera, where the file holds several.

    Raises:
        BadInput: one line naming file and key; with the names to choose from where there are
            several cameras.
    """
    path = Path(path)
    data = read_mapping(path)
    if "cameras" in data:
        entries = {entry.name: entry for entry in validate(RigFile, data, path).cameras}
        entry = entries[_choose(path, list(entries), name)]
        return entry.camera(), (entry.image_size_px[0], entry.image_size_px[1])
    if kalibr.is_camchain(data):
        chain = kalibr.camchain(path, data)
        link = chain[_choose(path, list(chain), name)]
        return link.camera(), (link.resolution[0], link.resolution[1])
    if name is not None and name != data.get("camera_name"):
        raise BadInput(path, f"holds one camera, and it is not named {name!r}")
    if "cameraIntrinsics" in data:
        return _photonvision(path, data)
    if "distortion_model" in data:
        return _camera_info(path, data)
    if data.keys() & {"camera_matrix", "cameraMatrix", "K"}:
        return _opencv(path, data)
    raise BadInput(
        path,
        "is no camera file that jaxnav knows: expected a rig (`cameras:`), a Kalibr camchain "
        "(`cam0:`), ROS's camera_info (`distortion_model:`), OpenCV's FileStorage "
        "(`camera_matrix:`) or PhotonVision's JSON (`cameraIntrinsics`)",
    )


def _choose(path: Path, names: list[str], name: str | None) -> str:
    if name is None and len(names) == 1:
        return names[0]
    if name in names:
        return name
    problem = "holds several cameras" if name is None else f"has no camera {name!r}"
    raise BadInput(path, f"{problem}: choose one of {', '.join(names)}")


def _camera_info(path: Path, data: dict[str, Any]) -> tuple[Camera, ImageSizePx]:
    info = validate(CameraInfo, data, path)
    lens = {"plumb_bob": "radtan", "rational_polynomial": "radtan", "equidistant": "equidistant"}
    model = info.distortion_model
    if model not in lens:
        problem = f"must be one of {', '.join(lens)}, got {model!r}"
        raise BadInput(at(path, "distortion_model"), problem)
    camera = _camera(
        (at(path, "camera_matrix.data"), info.camera_matrix.data),
        (at(path, "distortion_coefficients.data"), info.distortion_coefficients.data),
        lens[model],
    )
    return camera, (info.image_width, info.image_height)


def _opencv(path: Path, data: dict[str, Any]) -> tuple[Camera, ImageSizePx]:
    stored = validate(OpenCVCamera, data, path)
    if stored.image_size is not None:
        size = (stored.image_size[0], stored.image_size[1])
    elif stored.image_width is not None and stored.image_height is not None:
        size = (stored.image_width, stored.image_height)
    else:
        missing = "image_width" if stored.image_width is None else "image_height"
        raise BadInput(at(path, missing), "missing: for which image size are these figures?")
    camera = _camera(
        (at(path, "camera_matrix.data"), stored.camera_matrix.data),
        (at(path, "distortion_coefficients.data"), stored.distortion_coefficients.data),
        "equidistant" if stored.fisheye_model else "radtan",
    )
    return camera, size


def _photonvision(path: Path, data: dict[str, Any]) -> tuple[Camera, ImageSizePx]:
    stored = validate(PhotonVisionCamera, data, path)
    if "OPENCV" not in stored.lensmodel:
        problem = f"must be an OpenCV lens, got {stored.lensmodel!r}"
        raise BadInput(at(path, "lensmodel"), problem)
    camera = _camera(
        (at(path, "cameraIntrinsics.data"), stored.cameraIntrinsics.data),
        (at(path, "distCoeffs.data"), stored.distCoeffs.data),
        "radtan",
    )
    return camera, (int(stored.resolution.width), int(stored.resolution.height))


def _camera(
    matrix: tuple[str, Sequence[float]], distortion: tuple[str, Sequence[float]], lens: str
) -> Camera:
    """A camera from K (row by row) and the lens; each with its place in the file."""
    assert lens in LENSES
    where, K = matrix
    if len(K) != 9:
        raise BadInput(where, f"must be 3 x 3, got {len(K)} numbers")
    if K[0] == 0:
        raise BadInput(f"{where}[0]", "is 0: this camera has not been calibrated")
    for index in (0, 4):
        if K[index] < 1e-6:
            raise BadInput(f"{where}[{index}]", f"the focal length must be > 0, got {K[index]:g}")
    if any(abs(K[index]) > 1e-9 * K[0] for index in (1, 3, 6, 7)) or K[8] != 1:
        raise BadInput(where, "must be fx 0 cx, 0 fy cy, 0 0 1 (no skew)")
    where, coefficients = distortion
    most = 4 if lens == "equidistant" else 5
    if lens == "equidistant" and len(coefficients) != 4:
        raise BadInput(where, f"must be k1 k2 k3 k4 for a fisheye lens, got {len(coefficients)}")
    if any(coefficients[most:]):
        raise BadInput(
            where, f"only {_COEFFICIENTS} are supported, and a later one is not zero: "
            "calibrate again with five coefficients (plumb_bob, radtan)",
        )  # fmt: skip
    return Camera.create([K[0], K[4]], [K[2], K[5]], lens, coefficients[:most])
