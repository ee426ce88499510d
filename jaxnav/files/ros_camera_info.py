"""ROS's camera_info YAML, one camera a file, as camera_calibration writes it.

Source: the documentation of sensor_msgs/CameraInfo: D is k1 k2 t1 t2 k3 for plumb_bob, k1 to k4 for
equidistant; R is the identity and P is [K 0] for a camera that is not one of a stereo pair.
"""

from pathlib import Path
from typing import Any

from jaxnav.errors import BadInput
from jaxnav.files.figures import CameraFigures, Lens, unread_keys
from jaxnav.files.matrices import MatrixEntry, coefficients, figures_from_matrices, pinhole_matrix
from jaxnav.files.validation import ForeignEntry, Pixels, Text, at, validate
from jaxnav.files.writing import Quoted, yaml_text

_LENS: dict[str, Lens] = {
    "plumb_bob": "radtan",
    "rational_polynomial": "radtan",
    "equidistant": "equidistant",
}
_MODEL: dict[Lens, str] = {
    "none": "plumb_bob",
    "radtan": "plumb_bob",
    "rational": "rational_polynomial",
    "equidistant": "equidistant",
}
_IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


class CameraInfo(ForeignEntry):
    """A camera in ROS's camera_info YAML."""

    image_width: Pixels
    image_height: Pixels
    camera_matrix: MatrixEntry
    distortion_model: Text
    distortion_coefficients: MatrixEntry


def is_camera_info(data: dict[str, Any]) -> bool:
    """Whether a mapping looks like a camera_info."""
    return "distortion_model" in data


def camera_info_figures(path: Path, data: dict[str, Any], name: str) -> CameraFigures:
    """The camera of a camera_info.

    Raises:
        BadInput: one line naming file and key.
    """
    info = validate(CameraInfo, data, path)
    model = info.distortion_model
    if model not in _LENS:
        problem = f"must be one of {', '.join(_LENS)}, got {model!r}"
        raise BadInput(at(path, "distortion_model"), problem)
    return figures_from_matrices(
        name,
        (info.image_width, info.image_height),
        (at(path, "camera_matrix.data"), info.camera_matrix.data),
        (at(path, "distortion_coefficients.data"), info.distortion_coefficients.data),
        _LENS[model],
    )


def camera_info_left_out(data: dict[str, Any]) -> list[str]:
    """The keys that are not read and not empty, as a rectification is no part of a camera."""
    K = data["camera_matrix"]["data"]
    rectified = {
        "rectification_matrix": _IDENTITY,
        "projection_matrix": [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0],
    }
    plain = [
        key
        for key, expected in rectified.items()
        if isinstance(data.get(key), dict) and data[key].get("data") == expected
    ]
    return unread_keys(data, [*CameraInfo.model_fields, "camera_name", *plain])


def camera_info_text(camera: CameraFigures) -> str:
    """The camera as the text of a camera_info file."""
    K, D = pinhole_matrix(camera), coefficients(camera)
    projection = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
    data = {
        "image_width": camera.image_size_px[0],
        "image_height": camera.image_size_px[1],
        "camera_name": Quoted(camera.name),
        "camera_matrix": _matrix(3, 3, K),
        "distortion_model": _MODEL[camera.lens],
        "distortion_coefficients": _matrix(1, len(D), D),
        "rectification_matrix": _matrix(3, 3, _IDENTITY),
        "projection_matrix": _matrix(3, 4, projection),
    }
    return yaml_text(data)


def _matrix(rows: int, cols: int, data: list[float]) -> dict[str, Any]:
    return {"rows": rows, "cols": cols, "data": list(data)}
