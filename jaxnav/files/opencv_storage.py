"""Reading and writing OpenCV's FileStorage YAML: one camera a file, keys as in its samples.

OpenCV 3 and 4 head their files with `%YAML:1.0`, 5 with `%YAML 1.2`; all three read either.
"""

import json
from pathlib import Path
from typing import Annotated, Any

from pydantic import AliasChoices, Field

from jaxnav.errors import BadInput
from jaxnav.files.figures import CameraFigures, unread_keys
from jaxnav.files.matrices import MatrixEntry, coefficients, figures_from_matrices, pinhole_matrix
from jaxnav.files.validation import ForeignEntry, ImageSize, Pixels, at, validate

_MATRIX = ("camera_matrix", "cameraMatrix", "K")
_DISTORTION = ("distortion_coefficients", "distCoeffs", "D")
_SIZE = ("image_size", "imageSize", "image_width", "image_height")


class OpenCVCamera(ForeignEntry):
    """OpenCV's FileStorage of a camera, with the keys of its samples or its Python functions."""

    image_width: Pixels | None = None
    image_height: Pixels | None = None
    image_size: Annotated[ImageSize | None, Field(validation_alias=AliasChoices(*_SIZE[:2]))] = None
    camera_matrix: Annotated[MatrixEntry, Field(validation_alias=AliasChoices(*_MATRIX))]
    distortion_coefficients: Annotated[
        MatrixEntry, Field(validation_alias=AliasChoices(*_DISTORTION))
    ]
    fisheye_model: Annotated[int, Field(strict=True, ge=0, le=1)] = 0


def is_opencv(data: dict[str, Any]) -> bool:
    """Whether a mapping looks like OpenCV's camera."""
    return bool(data.keys() & set(_MATRIX))


def opencv_figures(path: Path, data: dict[str, Any], name: str) -> CameraFigures:
    """The camera of a FileStorage.

    Raises:
        BadInput: one line naming file and key.
    """
    stored = validate(OpenCVCamera, data, path)
    if stored.image_size is not None:
        size = (stored.image_size[0], stored.image_size[1])
    elif stored.image_width is not None and stored.image_height is not None:
        size = (stored.image_width, stored.image_height)
    else:
        missing = "image_width" if stored.image_width is None else "image_height"
        raise BadInput(at(path, missing), "missing: for which image size are these figures?")
    return figures_from_matrices(
        name,
        size,
        (at(path, "camera_matrix.data"), stored.camera_matrix.data),
        (at(path, "distortion_coefficients.data"), stored.distortion_coefficients.data),
        "equidistant" if stored.fisheye_model else "radtan",
    )


def opencv_left_out(data: dict[str, Any]) -> list[str]:
    """The keys that are not read and not empty, see `unread_keys`."""
    return unread_keys(data, [*_MATRIX, *_DISTORTION, *_SIZE, "fisheye_model", "camera_name"])


def opencv_text(camera: CameraFigures) -> str:
    """The camera as the text of a FileStorage file."""
    width, height = camera.image_size_px
    D = coefficients(camera)
    return (
        "%YAML:1.0\n---\n"
        f"camera_name: {json.dumps(camera.name, ensure_ascii=False)}\n"
        f"image_width: {width}\nimage_height: {height}\n"
        f"fisheye_model: {int(camera.lens == 'equidistant')}\n"
        + _matrix("camera_matrix", 3, 3, pinhole_matrix(camera))
        + _matrix("distortion_coefficients", len(D), 1, D)
    )


def _matrix(name: str, rows: int, cols: int, data: list[float]) -> str:
    numbers = ", ".join(repr(number) for number in data)
    head = f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n"
    return f"{head}   data: [ {numbers} ]\n"
