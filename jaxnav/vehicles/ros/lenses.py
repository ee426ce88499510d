"""The lenses of a rig as ROS's drivers publish them: sensor_msgs/CameraInfo.

An image as it comes has K and D. A rectified one, which apriltag_ros takes, has the first three
columns of P and no distortion.
"""

import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jaxlie

from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput
from jaxnav.files.matrix_cameras import CameraInfo
from jaxnav.files.rigs import CameraEntry
from jaxnav.files.validation import at, validate
from jaxnav.vehicles.ros.connection import Connection

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_WAIT_S, _LOOK_S = 10.0, 0.05  # for a CameraInfo, and between two looks
# Coefficients where D is empty.
_PLAIN = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}


def await_lenses(
    path: Path, topics: Mapping[str, str], rectified: bool, check: Callable[[], None]
) -> dict[str, CameraEntry]:
    """Wait for a CameraInfo on each topic.

    Args:
        path: the file that names the topics, for messages.
        topics: by the camera's name.
        check: called again and again; it raises where the wait is called off.

    Raises:
        BadInput: none comes, or one is no calibrated camera.
    """
    came: dict[str, Any] = {}
    if not topics:
        return {}
    connection = Connection("jaxnav_camera_info")
    try:
        for name, topic in topics.items():
            connection.listen(CAMERA_INFO, topic, partial(came.__setitem__, name))
        connection.run()
        until_s = time.monotonic() + _WAIT_S
        while len(came) < len(topics):
            check()
            if time.monotonic() > until_s:
                name = next(name for name in topics if name not in came)
                problem = f"no message on {topics[name]} for {_WAIT_S:g} s"
                raise BadInput(at(path, f"camera_info.{name}"), problem)
            time.sleep(_LOOK_S)
    finally:
        connection.close()
    return {name: read_lens(topics[name], message, rectified) for name, message in came.items()}


def read_lens(topic: str, message: Any, rectified: bool) -> CameraEntry:
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
    return validate(CameraInfo, data, Path(topic)).camera(topic)


def with_lenses(rig: CameraRig, lenses: Mapping[str, CameraEntry]) -> CameraRig:
    """The rig with other lenses and image sizes for the cameras of these names."""
    given = [lenses.get(name) for name in rig.names]
    return CameraRig.create(
        [rig.camera(c) if one is None else one.camera() for c, one in enumerate(given)],
        [jaxlie.SE3(wxyz_xyz) for wxyz_xyz in rig.Ts_camera_vehicle.wxyz_xyz],
        rig.names,
        [
            size_px if one is None else one.size_px
            for size_px, one in zip(rig.image_sizes_px, given, strict=True)
        ],
        rig.extrinsics_sigma,
        rig.timings,
    )
