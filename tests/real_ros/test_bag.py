"""A drive in a ROS 2 bag: through the node, and through `jaxnav replay`."""

import subprocess

import numpy as np
import pytest

from jaxnav.core.models.conventions import APRILTAG_PIXEL_EDGE_PX, TL_TR_BR_BL
from jaxnav.core.models.twists import twist_of
from jaxnav.drive.flags import Health
from jaxnav.files import calib_dir
from jaxnav.recordings.drive_log import read_drive
from tests.helpers.ros_bags import Bag
from tests.helpers.simulated import make_setup, simulated
from tests.real_ros.processes import JAXNAV, ROOT, node
from tests.real_ros.test_node_drives import Listener, stamp_s, write_file
from tests.worlds import qcar_rig

ORDER = np.argsort(TL_TR_BR_BL["bottom_left"])
SECONDS = 2.5
WHEELBASE_M = 0.256


def bag_of_a_drive(kind: str) -> Bag:
    """What a car drove, in lockstep, as another robot would have recorded it."""
    bag, names = Bag(kind), qcar_rig().names
    for step in simulated(make_setup(), SECONDS):
        given = step.input
        for frame in given.frames:
            found = frame.detections
            tags = [
                (family, int(marker), corners_px[ORDER] + APRILTAG_PIXEL_EDGE_PX)
                for family, marker, corners_px in zip(
                    found.families, found.ids, found.corners_px, strict=True
                )
            ]
            topic = f"/{names[frame.camera]}/detections"
            bag.apriltags(topic, given.now_ns, frame.stamp_ns, tags)
        if given.odometry is not None:
            reading = given.odometry
            twist = twist_of(reading.speed_mps, reading.steering_rad, WHEELBASE_M)
            bag.odometry("/odom", given.now_ns, reading.stamp_ns, *twist)
    return bag


@pytest.mark.parametrize("kind", [pytest.param("db3", marks=pytest.mark.long), "mcap"])
def test_a_bag_gives_the_states_of_a_replay(tmp_path, kind):
    path = bag_of_a_drive(kind).write(tmp_path)
    file = write_file(tmp_path)
    topics = tmp_path / "topics.yaml"
    lines = file.read_text().splitlines()
    topics.write_text("\n".join(one for one in lines if one.startswith(("cameras", "odom"))) + "\n")
    listener = Listener()
    try:
        words = ("--float64", "--bag", str(path), "--record", str(tmp_path / "node.mcap"))
        with node(tmp_path, str(file), *words) as program:
            assert program.ends(240.0) == 0, program.said
            assert "ended: the bag is over" in program.said
        heard = listener.heard["/jaxnav/pose"]
        assert heard
        assert {one.child_frame_id for m in listener.heard["/tf"] for one in m.transforms} == {
            "base_link"
        }
    finally:
        listener.connection.close()
    qcar = calib_dir() / "qcar"
    files = [f"--{name}={qcar / name}.yaml" for name in ("rig", "markers", "vehicle", "route")]
    out = tmp_path / "out"
    words = ("--topics", str(topics), *files, "--record-anew", "--headless", "--out", str(out))
    subprocess.run([*JAXNAV, "replay", str(path), *words], check=True, cwd=ROOT)
    ours, theirs = (read_drive(p).outcomes for p in (tmp_path / "node.mcap", out / "replay.mcap"))
    assert len(ours.now_ns) == len(theirs.now_ns) > 100
    np.testing.assert_array_equal(ours.now_ns, theirs.now_ns)
    np.testing.assert_array_equal(ours.health, theirs.health)
    assert Health.OK in ours.health
    np.testing.assert_allclose(ours.pose, theirs.pose, rtol=0, atol=1e-9)
    # What others heard of it are these poses.
    times_s = np.asarray(ours.now_ns) / 1e9
    for message in heard:
        at = int(np.argmin(np.abs(times_s - stamp_s(message))))
        there = message.pose.pose.position
        np.testing.assert_allclose([there.x, there.y], ours.pose[at][:2], atol=1e-6)
