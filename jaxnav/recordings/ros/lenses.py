"""The lenses of a rig as ROS's drivers tell them: sensor_msgs/CameraInfo.

An image as it comes has K and D. A rectified one, which apriltag_ros takes, has the first three
columns of P and no distortion.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jaxlie

from jaxnav.core.models.rig import CameraRig
from jaxnav.files.figures import CameraFigures
from jaxnav.files.matrix_cameras import CameraInfo
from jaxnav.files.validation import validate

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_PLAIN = {
    "plumb_bob": 5,
    "rational_polynomial": 8,
    "equidistant": 4,
}  # coefficients where D is empty


def figures_of(topic: str, message: Any, rectified: bool) -> CameraFigures:
    """The camera in a CameraInfo.

    Args:
        topic: for messages, and the camera's name.

    Raises:
        BadInput: one line naming topic and field; a camera that is not calibrated has zeros.
    """
    model = str(message.distortion_model) or "plumb_bob"
    matrix = [float(value) for value in message.k]
    coefficients = [float(value) for value in message.d] or [0.0] * _PLAIN.get(model, 5)
    if rectified:
        p = [float(value) for value in message.p]
        model, matrix, coefficients = "plumb_bob", [*p[0:3], *p[4:7], *p[8:11]], [0.0] * 5
    data = {
        "image_width": int(message.width),
        "image_height": int(message.height),
        "camera_matrix": {"rows": 3, "cols": 3, "data": matrix},
        "distortion_model": model,
        "distortion_coefficients": {"rows": 1, "cols": len(coefficients), "data": coefficients},
    }
    return validate(CameraInfo, data, Path(topic)).figures(Path(topic), topic)


def with_lenses(rig: CameraRig, lenses: Mapping[str, CameraFigures]) -> CameraRig:
    """The rig with other lenses and image sizes for the cameras of these names."""
    told = [lenses.get(name) for name in rig.names]
    return CameraRig.create(
        [rig.camera(c) if one is None else one.camera() for c, one in enumerate(told)],
        [jaxlie.SE3(wxyz_xyz) for wxyz_xyz in rig.Ts_camera_vehicle.wxyz_xyz],
        rig.names,
        [
            size_px if one is None else one.image_size_px
            for size_px, one in zip(rig.image_sizes_px, told, strict=True)
        ],
        rig.extrinsics_sigma,
        rig.timings,
    )
