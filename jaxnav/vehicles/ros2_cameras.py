"""Read cameras from ROS 2 topics: images, or the corners that another node has found.

Options, `--option KEY=VALUE`:

    camera.<name>     topic of each camera of the rig; one without a topic never has a frame
    camera_type       apriltag_msgs/msg/AprilTagDetectionArray, or sensor_msgs/msg/Image or
                      CompressedImage
    corner_sigma_px   of detections (0.3)
    first_corner      of detections, see `jaxnav.files.topics` (bottom_left)
    sim_time          true takes the time of /clock (false)
    stamps            monotonic, or ros: as they are in the messages
"""

from functools import partial
from typing import Any, get_args

from jaxnav.core.models.conventions import FirstCorner
from jaxnav.detection.types import Detections
from jaxnav.drive.interfaces import Camera, Frame, Setup, Vehicle
from jaxnav.errors import BadInput
from jaxnav.recordings.ros.camera_messages import (
    APRILTAG_ROS,
    COMPRESSED,
    IMAGE,
    detections,
    grey_image,
)
from jaxnav.vehicles.grabber import NewestFrame
from jaxnav.vehicles.options import by_camera, choice, number, switch
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros.source_clock import SourceClock

_PREFIX = "camera."


def open_cameras(setup: Setup, vehicle: Vehicle | None) -> list[Camera]:
    """Listen to a topic for each camera of the rig.

    Raises:
        ImportError: ROS 2 or one of its message packages is not there.
        BadInput: an option is wrong.
    """
    options, names = setup.options, setup.rig.names
    kind = choice(options, "camera_type", (APRILTAG_ROS, IMAGE, COMPRESSED))
    first_corner: Any = choice(options, "first_corner", get_args(FirstCorner))
    sigma_px = number(options, "corner_sigma_px", 0.3, 1e-3, 100.0)
    topics = by_camera(options, _PREFIX, names)
    if not topics:
        raise BadInput(f"--option {_PREFIX}{names[0]}", "missing: a topic of at least one camera")
    sim_time = switch(options, "sim_time")
    families = dict(zip(setup.markers.ids, setup.markers.families, strict=True))
    ros_time = choice(options, "stamps", ("monotonic", "ros")) == "ros"
    connection = Connection("jaxnav_cameras", sim_time, ros_time)

    def seen(message: Any) -> Detections:
        return detections(kind, message, first_corner, sigma_px, families)

    def take(camera: NewestFrame, clock: SourceClock, message: Any) -> None:
        stamp_ns = clock.time_ns(message.header.stamp)
        if kind == APRILTAG_ROS:
            camera.add(Frame(stamp_ns, detections=seen(message)))
        else:
            camera.add(Frame(stamp_ns, grey_image(kind, message)))

    def take_nothing(camera: NewestFrame) -> None:
        """A message that can't be read is a frame of now without a picture, which is flagged."""
        camera.add(Frame(connection.now_ns()))

    cameras = [NewestFrame(name, connection.close) for name in names]
    for camera in cameras:
        if camera.name in topics:
            connection.listen(
                kind,
                topics[camera.name],
                partial(take, camera, connection.source_clock()),
                failed=partial(take_nothing, camera),
            )
    connection.run()
    return list(cameras)


setattr(open_cameras, "needs_no_vehicle", True)  # noqa: B010  (a function has no such field)
