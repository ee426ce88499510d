"""A recorded rig, its frames played in real time over DDS, against `jaxnav replay`."""

import time

import jaxlie
import numpy as np
import pytest

from jaxnav.core.models.markers import MarkerMap
from jaxnav.detection.types import Detections
from jaxnav.files import save_markers, save_rig
from jaxnav.recordings.other.recordings import read_recording
from jaxnav.recordings.ros.camera_messages import APRILTAG_ROS, detections_message
from jaxnav.vehicles.ros.connection import Connection
from tests.real_ros.processes import JAXNAV, Program, node, until

FRAMES = 150
SIGMA_PX = 0.5
IDS = 1, 7


@pytest.mark.long
def test_frames_played_in_real_time_give_the_poses_of_a_replay(tmp_path, data_dir):
    folder = data_dir / "tagslam/test_7"
    markers = two_of(read_recording(folder).markers)
    recording = read_recording(folder, None, markers).first(FRAMES)
    save_rig(tmp_path / "rig.yaml", recording.rig)
    save_markers(tmp_path / "markers.yaml", markers)
    names = recording.rig.names
    topics = ", ".join(f"{name}: /{name}/detections" for name in names)
    file = tmp_path / "node.yaml"
    file.write_text(
        f"rig: rig.yaml\nmarkers: markers.yaml\ncameras: {{{topics}}}\n"
        f"corner_sigma_px: {SIGMA_PX}\n"
    )
    poses: dict[int, np.ndarray] = {}
    player = Connection("player", ros_time=True)
    publishers = [player.publisher(APRILTAG_ROS, f"/{name}/detections") for name in names]

    def take(message):
        p, q = message.pose.pose.position, message.pose.pose.orientation
        stamp = message.header.stamp
        stamp_ns = stamp.sec * 10**9 + stamp.nanosec
        poses[stamp_ns] = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])

    player.listen("geometry_msgs/msg/PoseWithCovarianceStamped", "/jaxnav/pose", take)
    player.run()
    out = tmp_path / "out"
    words = ("--limit", str(FRAMES), "--corner-sigma-px", str(SIGMA_PX), "--headless")
    words += ("--markers", str(tmp_path / "markers.yaml"), "--out", str(out))
    try:
        # Each compiles a program of its own, half a minute: both at once.
        with (
            Program(tmp_path / "replay.log", *JAXNAV, "replay", str(folder), *words) as replay,
            node(tmp_path, str(file), "--float64") as program,
        ):
            assert replay.ends(240.0) == 0, replay.said
            program.until("compiled in")
            until(lambda: all(p.get_subscription_count() for p in publishers), 60.0, program)
            play(player, publishers, recording)
            last_ns = int(recording.stamps_ns[-1])
            until(lambda: last_ns in poses, 60.0, program)
    finally:
        player.close()
    track = np.loadtxt(out / "trajectory.tum")
    stamps_ns = np.array(sorted(poses))
    compared = 0
    for row in track:
        at_ns = int(stamps_ns[np.argmin(np.abs(stamps_ns - row[0] * 1e9))])
        if abs(at_ns - row[0] * 1e9) < 1000:  # seconds since 1970 have 0.2 us in a float
            np.testing.assert_allclose(poses[at_ns], row[1:], atol=2e-9)  # of its nine digits
            compared += 1
    assert compared > 0.9 * len(track) > 50


def two_of(markers: MarkerMap) -> MarkerMap:
    """The two that the cameras see most: a map of all compiles half as long again."""
    at = np.flatnonzero(np.isin(markers.ids, IDS))
    poses = jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[at])
    families = tuple(markers.families[index] for index in at)
    return MarkerMap(poses, markers.size_m[at], ids=IDS, families=families)


def play(player, publishers, recording):
    """Publish every frame of every camera at its time."""
    begin_s, first_ns = time.monotonic(), int(recording.stamps_ns[0])
    families = recording.markers.families
    for frame, stamp_ns in enumerate(recording.stamps_ns.tolist()):
        time.sleep(max(begin_s + (stamp_ns - first_ns) / 1e9 - time.monotonic(), 0))
        corners_px, visible = recording.lanes(np.array([frame]))
        for camera, publisher in enumerate(publishers):
            seen = np.flatnonzero(np.asarray(visible)[0, camera])
            found = Detections(
                np.array([recording.markers.ids[m] for m in seen], int),
                np.asarray(corners_px, float)[0, camera, seen],
                np.full((len(seen), 4), SIGMA_PX),
                np.ones(len(seen), bool),
                tuple(families[m] for m in seen),
            )
            player.publish(publisher, detections_message(found, player.stamp(stamp_ns)))
