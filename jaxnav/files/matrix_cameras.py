"""Cameras as OpenCV's functions take them, K row by row and D, in the files of three tools.

Each of them writes one camera a file:

    ROS           camera_info YAML, as camera_calibration writes it
    OpenCV        FileStorage YAML, with the keys of its samples or of its Python functions
    PhotonVision  JSON of one camera at one resolution, as its calibration page exports and imports

Source of ROS's: the documentation of sensor_msgs/CameraInfo: D is k1 k2 t1 t2 k3 for plumb_bob, k1
to k4 for equidistant; R is the identity and P is [K 0] for a camera that is not one of a stereo
pair. OpenCV 3 and 4 head their files with `%YAML:1.0`, 5 with `%YAML 1.2`; all three read either.
PhotonVision keeps snapshots of the board and results from them (`observations`) in the same file.
"""

import json
from collections.abc import Container
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, AliasChoices, Field, field_validator, model_validator

from jaxnav.core.models.camera import LENS_COEFFICIENTS
from jaxnav.errors import BadInput
from jaxnav.files.ranges import pinhole_problem, problem_of
from jaxnav.files.rigs import CameraEntry, Lens
from jaxnav.files.validation import (
    Count,
    ForeignEntry,
    ImageSize,
    Number,
    Pixels,
    Text,
    Wrong,
    show_value,
    unread_keys,
)
from jaxnav.files.writing import yaml_text

_LENS: dict[str, Lens] = {
    "plumb_bob": "radtan",
    "rational_polynomial": "radtan",
    "equidistant": "equidistant",
}
# ROS's tools hand the coefficients of a rational_polynomial to OpenCV, however many there are.
_MODEL: dict[str, str] = {
    "none": "plumb_bob",
    "radtan": "plumb_bob",
    "rational": "rational_polynomial",
    "thin_prism": "rational_polynomial",
    "equidistant": "equidistant",
}
_PHOTONVISION_LENSES = ("none", "radtan", "rational")
_IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
_OPENCV_K = ("camera_matrix", "cameraMatrix", "K")
_OPENCV_D = ("distortion_coefficients", "distCoeffs", "D")
_OPENCV_SIZE = ("image_size", "imageSize", "image_width", "image_height")
_PHOTONVISION_D = ("distCoeffs", "cameraExtrinsics")
_PHOTONVISION_LENS = "LENSMODEL_OPENCV"
_CV_64F = 6  # OpenCV's number for a matrix of doubles, the `type` of a matrix


class MatrixEntry(ForeignEntry):
    """A matrix as ROS, OpenCV and PhotonVision write it.

    OpenCV 5 writes a vector with `sizes` alone.
    """

    rows: Count
    cols: Count
    data: Annotated[list[Number], Field(max_length=64)]

    @model_validator(mode="before")
    @classmethod
    def _a_vector(cls, entry: Any) -> Any:
        if isinstance(entry, dict) and "rows" not in entry and "sizes" in entry:
            sizes = entry["sizes"]
            if not isinstance(sizes, list) or len(sizes) != 1:
                raise ValueError(f"sizes: must be one number, got {show_value(sizes)}")
            return {**entry, "rows": sizes[0], "cols": 1}
        return entry

    @field_validator("data")
    @classmethod
    def _complete(cls, data: list[float], info: Any) -> list[float]:
        rows, cols = info.data.get("rows"), info.data.get("cols")
        if rows is not None and cols is not None and rows * cols != len(data):
            raise ValueError(f"must have {rows} x {cols} numbers, got {len(data)}")
        return data


class MatrixCamera(ForeignEntry):
    """The file of one camera.

    Attributes:
        format_keys: a file that has one of them is of this format.
        read_keys: what is read.
        matrices: the fields of K and of the lens's coefficients.
    """

    format_keys: ClassVar[tuple[str, ...]]
    read_keys: ClassVar[tuple[str, ...]]
    matrices: ClassVar[tuple[str, str]] = ("camera_matrix", "distortion_coefficients")

    def size_and_lens(self) -> tuple[list[int], Lens]:
        """Width and height of its images, px, and the kind of its lens: radtan for all of OpenCV's
        that are no fisheye."""
        raise NotImplementedError

    def left_out(self, data: dict[str, Any]) -> list[str]:
        """The keys of the file that are not read and not empty, see `unread_keys`."""
        return unread_keys(data, self.read_keys)

    @model_validator(mode="after")
    def _is_a_camera(self) -> Self:
        """Calibrated, without skew, and with a lens of no more coefficients than ours."""
        self.camera("")
        return self

    def camera(self, name: str) -> CameraEntry:
        """The camera under a given name.

        A radtan lens with more than five coefficients that matter is `rational`, with more than
        eight `thin_prism`.
        """
        size_px, lens = self.size_and_lens()
        K, coefficients = (getattr(self, field).data for field in self.matrices)
        in_K, in_lens = (f"{field}.data" for field in self.matrices)
        if len(K) != 9:
            raise Wrong(in_K, f"must be 3 x 3, got {len(K)} numbers")
        if K[0] == 0:
            raise Wrong(f"{in_K}[0]", "is 0: this camera has not been calibrated")
        for index in (0, 4):
            if K[index] <= 0:
                raise Wrong(f"{in_K}[{index}]", f"the focal length must be > 0, got {K[index]:g}")
        if any(abs(K[index]) > 1e-9 * K[0] for index in (1, 3, 6, 7)) or K[8] != 1:
            raise Wrong(in_K, "must be fx 0 cx, 0 fy cy, 0 0 1 (no skew)")
        pinhole_px = [K[index] for index in (0, 4, 2, 5)]
        if wrong := pinhole_problem(pinhole_px, size_px):
            raise Wrong(in_K, f"{wrong} (image_width and image_height, or resolution)")
        if lens == "radtan" and any(coefficients[5:]):
            lens = "thin_prism" if any(coefficients[8:]) else "rational"
        most = LENS_COEFFICIENTS[lens]
        if lens == "equidistant" and len(coefficients) != 4:
            problem = f"must be k1 k2 k3 k4 for a fisheye lens, got {len(coefficients)}"
            raise Wrong(in_lens, problem)
        if any(coefficients[most:]):
            raise Wrong(
                in_lens, "has tilt coefficients that are not zero: calibrate again with twelve "
                "(thin_prism), eight (rational) or five (plumb_bob, radtan)",
            )  # fmt: skip
        for index, value in enumerate(coefficients[:most]):
            if wrong := problem_of("distortion", value):
                raise Wrong(f"{in_lens}[{index}]", wrong)
        return CameraEntry.create(name, lens, pinhole_px, coefficients[:most], size_px)


class CameraInfo(MatrixCamera):
    """A camera in ROS's camera_info YAML."""

    format_keys = ("distortion_model",)
    image_width: Pixels
    image_height: Pixels
    camera_matrix: MatrixEntry
    distortion_model: Text
    distortion_coefficients: MatrixEntry

    def size_and_lens(self) -> tuple[list[int], Lens]:
        if self.distortion_model not in _LENS:
            problem = f"must be one of {', '.join(_LENS)}, got {self.distortion_model!r}"
            raise Wrong("distortion_model", problem)
        return [self.image_width, self.image_height], _LENS[self.distortion_model]

    def left_out(self, data: dict[str, Any]) -> list[str]:
        # A rectification is no part of a camera.
        rectified = {
            "rectification_matrix": _IDENTITY,
            "projection_matrix": _projection(data["camera_matrix"]["data"]),
        }
        plain = [
            key
            for key, expected in rectified.items()
            if isinstance(data.get(key), dict) and data[key].get("data") == expected
        ]
        return unread_keys(data, [*CameraInfo.model_fields, "camera_name", *plain])


class OpenCVCamera(MatrixCamera):
    """A camera in OpenCV's FileStorage."""

    format_keys = _OPENCV_K
    read_keys = (*_OPENCV_K, *_OPENCV_D, *_OPENCV_SIZE, "fisheye_model", "camera_name")
    image_width: Pixels | None = None
    image_height: Pixels | None = None
    image_size: Annotated[
        ImageSize | None, Field(validation_alias=AliasChoices(*_OPENCV_SIZE[:2]))
    ] = None
    camera_matrix: Annotated[MatrixEntry, Field(validation_alias=AliasChoices(*_OPENCV_K))]
    distortion_coefficients: Annotated[
        MatrixEntry, Field(validation_alias=AliasChoices(*_OPENCV_D))
    ]
    fisheye_model: Annotated[int, Field(strict=True, ge=0, le=1)] = 0

    def size_and_lens(self) -> tuple[list[int], Lens]:
        lens: Lens = "equidistant" if self.fisheye_model else "radtan"
        if self.image_size is not None:
            return self.image_size, lens
        if self.image_width is None or self.image_height is None:
            missing = "image_width" if self.image_width is None else "image_height"
            raise Wrong(missing, "missing: for which image size are these figures?")
        return [self.image_width, self.image_height], lens


def _whole(value: float) -> int:
    if value != int(value):
        raise ValueError(f"must be a whole number of pixels, got {value:g}")
    return int(value)


_Side = Annotated[float, Field(strict=True, ge=1, le=65536), AfterValidator(_whole)]


class Resolution(ForeignEntry):
    """PhotonVision's image size."""

    width: _Side
    height: _Side


class PhotonVisionCamera(MatrixCamera):
    """PhotonVision's JSON of a camera; older versions wrote the lens under `cameraExtrinsics`."""

    format_keys = ("cameraIntrinsics",)
    read_keys = ("resolution", "cameraIntrinsics", "lensmodel", *_PHOTONVISION_D)
    matrices = ("cameraIntrinsics", "distCoeffs")
    resolution: Resolution
    cameraIntrinsics: MatrixEntry
    distCoeffs: Annotated[MatrixEntry, Field(validation_alias=AliasChoices(*_PHOTONVISION_D))]
    lensmodel: Text = _PHOTONVISION_LENS

    def size_and_lens(self) -> tuple[list[int], Lens]:
        if "OPENCV" not in self.lensmodel:
            raise Wrong("lensmodel", f"must be an OpenCV lens, got {self.lensmodel!r}")
        return [int(self.resolution.width), int(self.resolution.height)], "radtan"


ONE_CAMERA_FORMATS: dict[Literal["photonvision", "ros", "opencv"], type[MatrixCamera]] = {
    "photonvision": PhotonVisionCamera,
    "ros": CameraInfo,
    "opencv": OpenCVCamera,
}


def camera_info_text(camera: CameraEntry) -> str:
    """The camera as the text of ROS's camera_info file.

    Raises:
        BadInput: a lens that ROS has no name for.
    """
    _require_held("ros", "ROS's camera_info knows radtan, rational and equidistant", camera, _MODEL)
    K, D = _pinhole_matrix(camera), _coefficients(camera)
    data = {
        "image_width": camera.image_size_px[0],
        "image_height": camera.image_size_px[1],
        "camera_name": camera.name,
        "camera_matrix": _matrix(3, 3, K),
        "distortion_model": _MODEL[camera.lens],
        "distortion_coefficients": _matrix(1, len(D), D),
        "rectification_matrix": _matrix(3, 3, _IDENTITY),
        "projection_matrix": _matrix(3, 4, _projection(K)),
    }
    return yaml_text(data)


def opencv_text(camera: CameraEntry) -> str:
    """The camera as the text of OpenCV's FileStorage file.

    Raises:
        BadInput: a lens that OpenCV has no functions for.
    """
    _require_held("opencv", "OpenCV knows radtan, rational and its fisheye", camera, _MODEL)

    def matrix(name: str, rows: int, cols: int, data: list[float]) -> str:
        numbers = ", ".join(repr(number) for number in data)
        head = f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n"
        return f"{head}   data: [ {numbers} ]\n"

    width, height = camera.image_size_px
    D = _coefficients(camera)
    return (
        "%YAML:1.0\n---\n"
        f"camera_name: {json.dumps(camera.name, ensure_ascii=False)}\n"
        f"image_width: {width}\nimage_height: {height}\n"
        f"fisheye_model: {int(camera.lens == 'equidistant')}\n"
        + matrix("camera_matrix", 3, 3, _pinhole_matrix(camera))
        + matrix("distortion_coefficients", len(D), 1, D)
    )


def photonvision_text(camera: CameraEntry) -> str:
    """The camera as PhotonVision's JSON, with no snapshots.

    Raises:
        BadInput: a lens that PhotonVision does not know.
    """
    _require_held("photonvision", "PhotonVision knows radtan alone", camera, _PHOTONVISION_LENSES)
    width, height = camera.image_size_px
    D = _coefficients(camera)
    data = {
        "resolution": {"width": float(width), "height": float(height)},
        "cameraIntrinsics": _matrix(3, 3, _pinhole_matrix(camera), type=_CV_64F),
        "distCoeffs": _matrix(1, len(D), D, type=_CV_64F),
        "calobjectWarp": [0.0, 0.0],
        "observations": [],
        "calobjectSize": {"width": 0.0, "height": 0.0},
        "calobjectSpacing": 0.0,
        "lensmodel": _PHOTONVISION_LENS,
    }
    return json.dumps(data, indent=2) + "\n"


def _require_held(to: str, what: str, camera: CameraEntry, lenses: Container[str]) -> None:
    if camera.lens not in lenses:
        raise BadInput(
            f"--to {to}: {camera.name}.lens",
            f"is {camera.lens}, and {what}: calibrate again with --lens radtan",
        )


def _pinhole_matrix(camera: CameraEntry) -> list[float]:
    """K of a camera, 9 numbers row by row."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.center_px
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def _projection(K: list[float]) -> list[float]:
    """[K 0], 12 numbers row by row."""
    return [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]


def _coefficients(camera: CameraEntry) -> list[float]:
    """D of a camera: k1 k2 p1 p2 k3 [k4 k5 k6 [s1 s2 s3 s4]], k1 k2 k3 k4 of a fisheye, zeros
    without a lens."""
    return list(camera.distortion) if camera.lens != "none" else [0.0] * 5


def _matrix(rows: int, cols: int, data: list[float], **also: int) -> dict[str, Any]:
    return {"rows": rows, "cols": cols, **also, "data": list(data)}
