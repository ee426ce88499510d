"""Pictures over real DDS: the node searches them itself, and localises."""

import pytest

from tests.real_ros.processes import node, sim_car, until
from tests.real_ros.sim_car import PICTURES, TOPICS
from tests.real_ros.test_node_drives import (
    CAMERAS,
    PATIENT,
    Listener,
    check_poses,
    check_tf,
    write_file,
)


# Two cameras send bgr8, two mono8.
@pytest.mark.parametrize("word", PICTURES)
def test_a_car_is_localised_by_its_cameras_pictures(tmp_path, word):
    kind = PICTURES[word]
    topics = ", ".join(f"{name}: /{name}/{TOPICS[kind]}" for name in CAMERAS)
    file = write_file(tmp_path, cameras=f"{{{topics}}}", camera_type=kind)
    listener = Listener()
    try:
        with (
            sim_car(tmp_path, word),
            node(tmp_path, str(file), *PATIENT) as program,
        ):
            until(lambda: len(listener.heard["/jaxnav/pose"]) > 150, 240.0, program)
            check_poses(listener)
            check_tf(listener)
    finally:
        listener.connection.close()
