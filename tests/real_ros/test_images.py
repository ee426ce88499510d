"""Pictures over real DDS: the node searches them itself, and localises."""

from jaxnav.recordings.ros.camera_messages import IMAGE
from tests.real_ros.processes import node, sim_car, until
from tests.real_ros.sim_car import TOPICS
from tests.real_ros.test_node_drives import (
    CAMERAS,
    PATIENT,
    Listener,
    check_poses,
    check_tf,
    write_file,
)


def test_a_car_is_localised_by_its_cameras_pictures(tmp_path):
    """Two cameras send bgr8, two mono8."""
    topics = ", ".join(f"{name}: /{name}/{TOPICS[IMAGE]}" for name in CAMERAS)
    file = write_file(tmp_path, cameras=f"{{{topics}}}", camera_type=IMAGE)
    listener = Listener()
    try:
        with (
            sim_car(tmp_path, "--images"),
            node(tmp_path, str(file), *PATIENT) as program,
        ):
            until(lambda: listener.has_driven(1.8), 240.0, program)
            check_poses(listener)
            check_tf(listener)
    finally:
        listener.connection.close()
