"""Recordings: the same detections from bags and arrays, and one line for an unreadable one."""

import bz2
import functools
import io
import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav import files
from jaxnav.recordings.other.recordings import Recording, read_recording
from tests.helpers import seed_texts
from tests.helpers.bad_input import problem
from tests.helpers.ros_bags import Bag

refused = functools.partial(problem, read_recording)
DECODED = {"test_5": (2716, 28062, 2715), "test_7": (347, 3235, 347)}  # frames, used, referenced
FRAMES = {"test_5": 2751, "test_7": 454}


@pytest.fixture(scope="module", params=["test_7", "test_5"])
def recording(request, data_dir) -> tuple[Recording, Recording]:
    """A folder of bags, and the same decoded."""
    folder = data_dir / "tagslam" / request.param
    return read_recording(folder), read_recording(folder / "decoded.npz")


# --- the real recordings --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["test_2", "test_21", "test_22", pytest.param("test_9", marks=pytest.mark.long)]
)
def test_every_public_recording_is_read(data_dir, name):
    """Lenses with k3 too, which test_21 has."""
    read = read_recording(data_dir / "tagslam" / name)
    assert read.visible.any()
    assert read.reference.valid.any()


def test_bags_and_arrays_hold_the_same(recording):
    bag, npz = recording
    frames, used, referenced = DECODED[bag.name]
    assert (len(bag), len(npz), npz.name) == (FRAMES[bag.name], frames, bag.name)
    # The arrays hold no frame without a detection; the bags do.
    seen = np.isin(bag.stamps_ns, npz.stamps_ns)
    assert not bag.visible[~seen].any()
    np.testing.assert_array_equal(bag.stamps_ns[seen], npz.stamps_ns)
    np.testing.assert_array_equal(bag.visible[seen], npz.visible)
    np.testing.assert_array_equal(bag.corners_px[seen], npz.corners_px)
    assert npz.visible.sum() == used
    assert npz.reference.valid.sum() == referenced
    np.testing.assert_array_equal(bag.reference.valid[seen], npz.reference.valid)
    assert not bag.reference.valid[~seen].any()
    np.testing.assert_allclose(
        bag.reference.T_world_vehicle[seen], npz.reference.T_world_vehicle, atol=1e-12
    )
    assert bag.markers.ids == npz.markers.ids
    assert bag.rig.names == npz.rig.names
    ours, theirs = jax.tree.leaves((bag.rig, bag.markers)), jax.tree.leaves((npz.rig, npz.markers))
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
    assert bag.unmapped_detections == npz.unmapped_detections == (bag.name == "test_5")
    assert bag.dropped_detections == npz.dropped_detections == 0
    for one in recording:
        assert np.isfinite(one.corners_px).all()
        assert np.isfinite(one.reference.T_world_vehicle).all()
        assert (np.diff(one.stamps_ns) > 0).all()
    part = bag.first(20)
    assert (len(part), part.visible.shape[0], len(part.reference.valid)) == (20, 20, 20)
    assert len(bag.first(10**6)) == len(bag)


def residuals_px(recording: Recording) -> np.ndarray:
    """(N, 4, 2): recorded minus projected through our own camera model and the reference."""

    @jax.jit
    @jax.vmap
    def projected(T_world_vehicle):
        T_vehicle_world = jaxlie.SE3(T_world_vehicle).inverse()
        return recording.rig.project(T_vehicle_world, recording.markers.corners_world_m)

    chunks = []
    for start in range(0, len(recording), 512):
        part = slice(start, start + 512)
        valid = recording.reference.valid[part]
        poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (512, 1))  # one shape, one compilation
        poses[: len(valid)] = recording.reference.T_world_vehicle[part]
        pixels = np.asarray(projected(jnp.asarray(poses)))
        lanes = recording.visible[part] & valid[:, None, None]
        chunks.append((recording.corners_px[part] - pixels[: len(valid)])[lanes])
    return np.concatenate(chunks)


def test_the_reference_reprojects_as_its_makers_say(recording):
    """Corner order, frames, lens and pixel origin, all at once: most errors cost tens of pixels."""
    residuals = residuals_px(recording[1])
    rms = {shift: np.sqrt(np.mean((residuals + shift) ** 2)) for shift in (-0.5, 0.0, 0.5)}
    assert rms[0.0] == pytest.approx(
        {"test_5": 0.892, "test_7": 2.217}[recording[1].name], abs=0.01
    )
    assert np.median(np.linalg.norm(residuals, axis=-1)) < 1.0
    # The recorded pixels need no half-pixel shift to agree with calibration and reference.
    assert rms[0.0] < min(rms[-0.5], rms[0.5])


def test_a_bag_with_a_rig_and_a_map_of_its_own(data_dir, tmp_path):
    """The bag alone, everything else from files of ours, written from the folder."""
    folder = data_dir / "tagslam" / "test_7"
    whole = read_recording(folder)
    names = ["bottom_left", "bottom_right", "top_left", "top_right"]
    rig = type(whole.rig)(
        whole.rig.cameras, whole.rig.Ts_camera_vehicle, tuple(names), whole.rig.image_sizes_px
    )
    files.save_rig(tmp_path / "rig.yaml", rig)
    files.save_markers(tmp_path / "markers.yaml", whole.markers)
    alone = read_recording(
        folder / "tag_detections.bag.bz2",
        files.load_rig(tmp_path / "rig.yaml"),
        files.load_markers(tmp_path / "markers.yaml"),
    )
    np.testing.assert_array_equal(alone.corners_px, whole.corners_px)
    np.testing.assert_array_equal(alone.visible, whole.visible)
    assert alone.reference is None
    line = refused(folder / "tag_detections.bag.bz2", whole.rig, whole.markers)
    assert "no topic" in line
    assert "'cam0'" in line
    assert "/quadruple/bottom_left/tags (apriltag_msgs/msg/ApriltagArrayStamped)" in line


# --- bags made here -------------------------------------------------------------------------------

SQUARE_PX = np.array([[10.0, 30], [30, 30], [30, 10], [10, 10]])  # BL BR TR TL in the image
Seen = dict[str, list[tuple[int, list[tuple[int, np.ndarray]]]]]


def write_bag(path: Path, seen: Seen, transforms: Any = (), odometry: Any = None) -> Path:
    """A bag with topic -> [(stamp in ns, [(id, corners)])] and [(parent, child, wxyz xyz)].

    Args:
        odometry: topic -> [(stamp in ns, wxyz xyz)].
    """
    bag = Bag("bag")
    for topic, messages in seen.items():
        for stamp, tags in messages:
            bag.tagslam(topic, stamp, stamp, tags)
    for parent, child, pose in transforms:
        bag.transform(5, parent, child, pose)
    for topic, poses in (odometry or {}).items():
        for stamp, pose in poses:
            bag.odometry(topic, stamp, stamp, 0.0, 0.0, pose)
    return bag.write(path.parent).rename(path)


@pytest.fixture
def rig():
    return files.load_rig(files.calib_dir() / "qcar" / "rig.yaml")


@pytest.fixture
def markers():
    return files.load_markers(files.calib_dir() / "qcar" / "markers.yaml")


QCAR_TOPICS = ("/front/tags", "/right/tags", "/rear/tags", "/left/tags")


def test_corners_frames_and_counts(tmp_path, rig, markers):
    nowhere = np.where(SQUARE_PX == 30, 1e300, SQUARE_PX)
    seen: Seen = {topic: [(10, []), (20, [])] for topic in QCAR_TOPICS}
    seen["/front/tags"] = [(10, [(0, SQUARE_PX), (7, SQUARE_PX)]), (20, [(0, nowhere)])]
    seen["/left/tags"] = [(10, [(0, SQUARE_PX), (0, SQUARE_PX + 5)]), (30, [(0, SQUARE_PX + 1)])]
    read = read_recording(write_bag(tmp_path / "a.bag", seen), rig, markers)
    np.testing.assert_array_equal(read.stamps_ns, [10, 20, 30])
    expected = np.zeros((3, 4, 1), bool)
    expected[0, 0, 0] = expected[2, 3, 0] = True  # the marker seen twice on the left is not used
    np.testing.assert_array_equal(read.visible, expected)
    top_left_first = [[10, 10], [30, 10], [30, 30], [10, 30]]
    np.testing.assert_array_equal(read.corners_px[0, 0, 0], top_left_first)
    assert (read.unmapped_detections, read.dropped_detections) == (1, 3)
    assert read.name == "a.bag"


def test_topics_are_matched_by_name_or_named(tmp_path, rig, markers):
    seen: Seen = {topic: [(10, [])] for topic in QCAR_TOPICS[1:]}
    line = refused(write_bag(tmp_path / "a.bag", seen), rig, markers)
    assert "belongs to the camera 'front'; topics found: /left/tags (apriltag_msgs" in line
    seen |= {"/front/a": [(10, [])], "/front/b": [(10, [])]}
    assert "several topics" in problem(
        read_recording, write_bag(tmp_path / "b.bag", seen), rig, markers
    )
    bag = write_bag(tmp_path / "c.bag", seen | {"/front": [(10, [])]})
    read = read_recording(bag, rig, markers)
    assert (len(read), read.visible.any()) == (1, False)  # a frame without markers
    assert refused(bag).startswith("--rig: missing")
    assert refused(bag, rig).startswith("--markers: missing")


CAMERAS, TAGSLAM, POSES = (
    seed_texts.TAGSLAM[name] for name in ("cameras.yaml", "tagslam.yaml", "camera_poses.yaml")
)
UNIT = (1.0, 0.0, 0.0, 0.0)


@pytest.fixture
def folder(tmp_path) -> Path:
    """A TagSLAM folder without a reference."""
    folder = tmp_path / "drive"
    folder.mkdir()
    for name, text in (("cameras", CAMERAS), ("tagslam", TAGSLAM), ("camera_poses", POSES)):
        (folder / f"{name}.yaml").write_text(text)
    write_bag(folder / "seen.bag", {"/a/tags": [(5, [(3, SQUARE_PX), (4, SQUARE_PX)])]})
    return folder


def test_a_folder_without_transforms_takes_its_poses_from_yaml(folder):
    read = read_recording(folder)
    assert (read.markers.ids, read.rig.names, read.reference) == ((3,), ("cam0",), None)
    assert (float(read.markers.size_m[0]), read.unmapped_detections) == (0.25, 1)
    translation = read.markers.Ts_world_marker.translation()[0]
    np.testing.assert_allclose(translation, [1, 2, 0], atol=1e-12)
    T_vehicle_camera = read.rig.Ts_camera_vehicle.inverse().as_matrix()[0]
    expected = np.diag([-1.0, 1, -1, 1])
    expected[0, 3] = 0.1
    np.testing.assert_allclose(T_vehicle_camera, expected, atol=1e-12)


def test_a_folder_with_transforms_takes_its_poses_from_them(folder):
    transforms = [
        ("map", "wall", (*UNIT, 1.0, 0, 0)),
        ("wall", "tag_4", (*UNIT, 0, 2.0, 0)),
        ("cart", "cam0", (*UNIT, 0, 0, 3.0)),
        ("map", "cart", (*UNIT, 7.0, 8, 9)),
        ("wall", "o_tag_9", (*UNIT, 0, 0, 0)),
    ]
    write_bag(folder / "result.bag", {}, transforms)
    read = read_recording(folder)
    assert (read.markers.ids, float(read.markers.size_m[0])) == ((4,), 0.5)
    translation = read.markers.Ts_world_marker.translation()[0]
    np.testing.assert_allclose(translation, [1, 2, 0], atol=1e-12)
    np.testing.assert_allclose(read.rig.Ts_camera_vehicle.translation()[0], [0, 0, -3], atol=1e-12)
    np.testing.assert_array_equal(read.reference.valid, [True])
    np.testing.assert_allclose(read.reference.T_world_vehicle, [[*UNIT, 7, 8, 9]], atol=1e-12)


def test_tags_that_stand_for_others_are_renamed_and_some_left_out(folder):
    """For a while, in one camera; a squashed time is a text, which keeps its digits."""
    path, at_ns = folder / "tagslam.yaml", 1_527_206_556_891_942_748
    path.write_text(
        path.read_text().replace(
            "default_tag_size: 0.5", "default_tag_size: 0.5\n     ignore_tags: [8]"
        )
        + "tag_id_remap: [{id: 7, remaps: ["
        "{remap_id: 3, start_time: 1527206556.5, end_time: 1527206557.0},"
        " {remap_id: 3, camera: cam9, start_time: 0, end_time: 1527206556.0}]}]\n"
        f"squash: [{{time: '{at_ns // 10**9}.{at_ns % 10**9}', tags: [3]}},"
        " {camera: cam9, tags: [3]}]\n"
    )
    early_ns, late_ns = at_ns - 10**9, at_ns + 10**6
    tags = [(tag, SQUARE_PX + 9 * tag) for tag in (3, 7, 8)]
    (folder / "seen.bag").unlink()
    seen = [(early_ns, tags), (at_ns, tags), (late_ns, tags[1:])]
    write_bag(folder / "seen.bag", {"/a/tags": seen})
    read = read_recording(folder)
    np.testing.assert_array_equal(read.visible[:, 0, 0], [True, True, True])
    shift_px = read.corners_px[:, 0, 0, 0, 0] - SQUARE_PX[:, 0].min()
    np.testing.assert_array_equal(shift_px, [27, 63, 63])  # id 3, then id 7 in its place
    assert read.unmapped_detections == 1  # id 7 early; id 8 is nowhere
    path.write_text(path.read_text().replace("end_time: 1527206557.0", "end_time: late"))
    assert f"{path}: tag_id_remap[0].remaps[0].end_time: " in refused(folder)


BOARD = """
bodies:
 - sheet:
     is_static: true
     type: KIND
     pose: {position: {x: 5, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0}}
     KIND: {tag_start_id: 12, tag_size: 0.1, tag_spacing: 0.5, tag_rows: 2, tag_columns: 3}
"""


@pytest.mark.parametrize(
    ("kind", "places_m"),
    [
        ("board", [(0, 0), (0.15, 0), (0.3, 0), (0, 0.15), (0.15, 0.15), (0.3, 0.15)]),
        ("staggered_board", [(0, 0), (0.3, 0), (0.15, -0.15)]),
    ],
)
def test_a_board_is_its_tags(folder, kind, places_m):
    """As TagSLAM lays them out, each of the board's size."""
    path = folder / "tagslam.yaml"
    path.write_text(BOARD.replace("KIND", kind))
    markers = read_recording(folder).markers
    assert markers.ids == tuple(range(12, 12 + len(places_m)))
    expected_m = [(x_m + 5, y_m, 0.0) for x_m, y_m in places_m]
    np.testing.assert_allclose(markers.Ts_world_marker.translation(), expected_m, atol=1e-12)
    np.testing.assert_allclose(markers.size_m, 0.1)


def pose_at(x_m: float, yaw_rad: float) -> tuple[float, ...]:
    return (np.cos(yaw_rad / 2), 0, 0, np.sin(yaw_rad / 2), x_m, 0, 0)


def moving(folder: Path, *standing: Any) -> Recording:
    """The rig and the wall both move; the wall has tag 3, a metre before it."""
    path = folder / "tagslam.yaml"
    path.write_text(
        path.read_text().replace("wall:\n     is_static: true", "wall:\n     is_static: false")
    )
    seen = [(stamp, [(3, SQUARE_PX), (4, SQUARE_PX + 40)]) for stamp in (5, 6, 7)]
    bag = Bag("bag")
    for stamp, tags in seen:
        bag.tagslam("/a/tags", stamp, stamp, tags)
    bag.transform(5, "wall", "tag_3", pose_at(1.0, 0.0))
    bag.transform(5, "cart", "cam0", pose_at(0.0, 0.0))
    for edge in standing:
        bag.transform(5, *edge)
    for index, stamp in enumerate((5, 6, 7)):
        bag.transform(stamp, "map", "wall", pose_at(10.0 * index, 0.3 * index))
        bag.transform(stamp, "map", "cart", pose_at(10.0 * index, 0.3 * index + 0.1))
    (folder / "seen.bag").unlink()
    bag.write(folder).rename(folder / "seen.bag")
    return read_recording(folder)


def test_a_body_that_moves_with_all_tags_is_the_world(folder):
    read = moving(folder)
    assert read.markers.ids == (3,)
    np.testing.assert_allclose(read.markers.Ts_world_marker.translation(), [[1.0, 0, 0]], atol=1e-9)
    expected = np.tile(pose_at(0.0, 0.1), (3, 1))
    np.testing.assert_allclose(read.reference.T_world_vehicle, expected, atol=1e-9)


def test_tags_on_a_body_that_moves_are_no_landmarks(folder):
    read = moving(folder, ("map", "tag_4", pose_at(2.0, 0.0)))
    assert (read.markers.ids, read.unmapped_detections) == ((4,), 3)
    np.testing.assert_allclose(read.markers.Ts_world_marker.translation(), [[2.0, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(read.reference.T_world_vehicle[:, 4], [0, 10, 20], atol=1e-9)


ODOMETRY = """
 - cart:
     is_static: false
     odom_topic: /vio
     T_body_odom: {position: {x: 0, y: 0, z: 0.5}, rotation: {x: 0, y: 0, z: 1.5707963267948966}}
"""


def test_a_folder_s_odometry_is_the_motion_of_the_rig(folder):
    path = folder / "tagslam.yaml"
    path.write_text(path.read_text().rstrip() + ODOMETRY)
    assert refused(folder).startswith(f"{path}: bodies.cart.odom_topic: no bags have /vio of nav_")
    rng = np.random.default_rng(0)
    times_s = np.array([0.9, 1.0, 1.1, 1.25, 2.5, 2.6])
    start, twist = jaxlie.SE3.exp(jnp.asarray(rng.normal(size=6))), rng.normal(size=6)
    T_cart_odom = jaxlie.SE3(jnp.asarray([np.sqrt(0.5), 0, 0, np.sqrt(0.5), 0, 0, 0.5]))
    poses = [start @ jaxlie.SE3.exp(jnp.asarray(twist * t)) @ T_cart_odom for t in times_s]
    (folder / "seen.bag").unlink()
    write_bag(
        folder / "seen.bag",
        {"/a/tags": [(int(t * 1e9), [(3, SQUARE_PX)]) for t in (0.5, 1.0, 1.1, 1.25, 2.0, 2.6)]},
        odometry={
            "/vio": [
                (int(t * 1e9), np.asarray(p.wxyz_xyz).tolist())
                for t, p in zip(times_s, poses, strict=True)
            ]
        },
    )
    read = read_recording(folder)
    # Nothing is told before its first pose, nor within a gap of 1.25 s.
    np.testing.assert_array_equal(np.isfinite(read.twists).all(axis=1), [0, 0, 1, 1, 0, 0])
    np.testing.assert_allclose(read.twists[2:4], np.tile(twist, (2, 1)), atol=1e-9)
    assert read.first(3).twists.shape == (3, 6)
    np.testing.assert_allclose(read.odometry.sigma, [0.03, *3 * [np.deg2rad(1.0)]])
    np.testing.assert_allclose(read.odometry.errors().lever_arm_m, [0, 0, 0.5])
    whole = path.read_text()
    keys = "odom_topic: /vio\n     odom_delay_s: -0.1\n     odom_sigma: {scale: 0.1, turn_deg: 0}"
    path.write_text(whole.replace("odom_topic: /vio", keys))
    late = read_recording(folder)
    np.testing.assert_allclose(late.odometry.sigma, [0.1, 0, 0, 0])
    np.testing.assert_array_equal(late.odometry.stamps_ns, read.odometry.stamps_ns + 10**8)
    for key, value in (("odom_delay_s: -0.1", "odom_delay_s: -46"), ("scale: 0.1", "scale: 7")):
        path.write_text(whole.replace("odom_topic: /vio", keys.replace(key, value)))
        assert f"{path}: bodies[2].cart.odom_" in refused(folder)
    path.write_text(whole.replace("T_body_odom", "T_odom_body"))
    assert f"{path}: bodies.cart.T_body_odom: missing" in refused(folder)


def test_odometry_between_its_poses(data_dir):
    """A real one, 30 Hz, against the reference: 1.4 mm and 0.07 degrees in 0.2 s."""
    read = read_recording(data_dir / "tagslam" / "test_21")
    rows = np.flatnonzero(read.reference.valid)
    dt_s = np.diff(read.stamps_ns, prepend=read.stamps_ns[:1]) / 1e9
    steps = jaxlie.SE3.exp(jnp.asarray(read.twists * dt_s[:, None])).as_matrix()
    truth = jaxlie.SE3(jnp.asarray(read.reference.T_world_vehicle[rows])).as_matrix()
    errors = []
    for index, (begin, end) in enumerate(itertools.pairwise(rows)):
        told = functools.reduce(np.matmul, np.asarray(steps[begin + 1 : end + 1]))
        errors.append(np.linalg.inv(told) @ np.linalg.inv(truth[index]) @ truth[index + 1])
    twists = np.asarray(jaxlie.SE3.from_matrix(jnp.asarray(errors)).log())
    assert np.isfinite(twists).all()
    assert np.median(np.linalg.norm(twists[:, :3], axis=1)) < 0.003
    assert np.median(np.linalg.norm(twists[:, 3:], axis=1)) < np.deg2rad(0.2)


def test_a_bad_folder_is_named_with_file_and_key(folder):
    known = "pose: {position: {x: 2", "p: {position: {x: 2"
    for file, old, new, expected in [
        ("cameras", "equidistant", "fov", "cam0.distortion_model: must be one of"),
        ("cameras", "pinhole", "fov", "cam0.camera_model: must be 'pinhole', "),
        ("cameras", "pinhole", "omni", "cam0.intrinsics: must be xi fu fv pu pv"),
        ("cameras", "[400,", "[0,", "cam0.intrinsics: the focal lengths must be > 0"),
        ("cameras", "/a/tags", "/b/tags", "cam0.tagtopic: no bags have /b/tags of apriltag_msgs"),
        ("cameras", "tagtopic", "topic", "cam0.tagtopic: missing"),
        ("camera_poses", "cam0", "cam1", "cam0: missing, and no /tf from cart"),
        ("camera_poses", "x: 0.1", "x: ten", "cam0.pose.position.x: must be a number"),
        ("tagslam", *known, "bodies: has no static"),
        ("tagslam", "size: 0.25", "size: -1", "bodies[0].wall.tags[0].size: must be > 0, got -1"),
        ("tagslam", "bodies:", "body:", "bodies: missing"),
    ]:
        path = folder / f"{file}.yaml"
        sound = path.read_text()
        assert old in sound
        path.write_text(sound.replace(old, new, 1))
        assert refused(folder).startswith(f"{path}: {expected}")
        path.write_text(sound)


def test_an_incomplete_folder_is_one_line(folder, rig):
    assert refused(folder, rig).startswith("--rig: has 4 cameras, but")
    (folder / "tagslam.yaml").unlink()
    assert "tagslam.yaml: can't be read: no such file" in refused(folder)
    (folder / "seen.bag").unlink()
    assert refused(folder) == f"{folder}: holds no .bag and no .bag.bz2"


# --- files that are broken ------------------------------------------------------------------------


def test_a_packed_bag_is_read_whole_or_refused(tmp_path, rig, markers):
    seen: Seen = {topic: [(t, [(0, SQUARE_PX)]) for t in range(1, 50)] for topic in QCAR_TOPICS}
    raw = write_bag(tmp_path / "whole.bag", seen).read_bytes()
    packed = tmp_path / "packed.bag.bz2"
    packed.write_bytes(bz2.compress(raw))
    assert len(read_recording(packed, rig, markers)) == 49
    for content, expected in (
        (bz2.compress(raw)[:-40], "can't be decompressed"),
        (raw, "can't be decompressed"),
        (bz2.compress(b"no bag"), "is not a readable ROS bag"),
        (bz2.compress(raw[:-3]), "is not a readable ROS bag"),
    ):
        packed.write_bytes(content)
        assert refused(packed, rig, markers).startswith(f"{packed}: {expected}")


def test_a_transform_that_is_not_rigid_is_refused(folder):
    write_bag(folder / "result.bag", {}, [("cart", "cam0", (0.0, 0, 0, 0, 0, 0, 0))])
    assert "the transform from cam0 to cart is not rigid" in refused(folder)
    (folder / "result.bag").unlink()
    write_bag(folder / "other.bag", {"/a/tags": [(5, [(3, SQUARE_PX[:3])])]})
    (folder / "seen.bag").unlink()
    assert "marker 3 has 3 corners" in refused(folder)


def test_what_is_no_recording_is_one_line(tmp_path):
    assert "there is no such file or folder" in refused(tmp_path / "none")
    assert "holds no .bag" in refused(tmp_path)
    (tmp_path / "a.txt").write_text("x")
    assert "is no recording" in refused(tmp_path / "a.txt")


def arrays() -> dict[str, np.ndarray]:
    """A small decoded recording."""
    return {
        "stamp_ns": np.array([5, 5, 9]),
        "cam": np.array([0, 1, 1]),
        "tag_id": np.array([3, 3, 4]),
        "corners_px": np.stack([SQUARE_PX] * 3),
        "cam_names": np.array(["cam0", "cam1"]),
        "K": np.array([[400.0, 400, 320, 240]] * 2),
        "dist": np.zeros((2, 5)),
        "dist_model": np.array(["equidistant", "radtan"]),
        "T_rig_cam": np.stack([np.eye(4)] * 2),
        "map_ids": np.array([3]),
        "map_size": np.array([0.15]),
        "T_map_tag": np.eye(4)[None],
        "rig_stamp": np.array([9]),
        "T_map_rig": np.eye(4)[None],
    }


def test_arrays_are_read(tmp_path):
    np.savez(tmp_path / "a.npz", **arrays())
    read = read_recording(tmp_path / "a.npz")
    np.testing.assert_array_equal(read.visible[..., 0], [[True, True], [False, False]])
    np.testing.assert_array_equal(read.reference.valid, [False, True])
    assert (read.name, read.unmapped_detections) == ("a", 1)
    assert read.rig.cameras.lenses == ("equidistant", "radtan")
    assert read.rig.image_sizes_px == ((641, 481),) * 2  # twice the principal point
    bare = {key: v for key, v in arrays().items() if key not in ("rig_stamp", "T_map_rig")}
    np.savez(tmp_path / "b.npz", **bare)
    assert read_recording(tmp_path / "b.npz").reference is None


def _npy() -> bytes:
    file = io.BytesIO()
    np.save(file, np.zeros(3))
    return file.getvalue()


def test_bad_arrays_are_named_with_their_key(tmp_path):
    path = tmp_path / "a.npz"
    for broken, expected in ((b"", ""), (b"garbage" * 100, ""), (_npy(), "ValueError: it holds a")):
        path.write_bytes(broken)
        assert refused(path).startswith(f"{path}: is not a readable .npz file ({expected}")
    mirrored = np.stack([np.diag([1.0, 1, -1, 1])] * 2)
    backwards = arrays()["corners_px"][:, ::-1]
    for key, value, expected in [
        ("K", None, "K: missing"),
        ("T_map_rig", None, "T_map_rig: missing"),
        ("corners_px", np.zeros((3, 4)),
         "corners_px: must have the shape (N, 4, 2), got (3, 4)"),
        ("corners_px", np.zeros((2, 4, 2)),
         "corners_px: must have the shape (N, 4, 2), for stamp_ns has N = 3, got (2, 4, 2)"),
        ("corners_px", np.full((3, 4, 2), "x"), "corners_px: must hold numbers, got <U1"),
        ("cam", np.array([0, 1, 2]), "cam: must be from 0 to 1"),
        ("cam", np.array([0.0, 1, 1]), "cam: must hold whole numbers, got float64"),
        ("stamp_ns", np.array([{}, 5, 9]), "is not a readable .npz file (ValueError: Object arr"),
        ("dist_model", np.array(["fov", "none"]), "dist_model[0]: must be one of none,"),
        ("dist", np.ones((2, 5)), "dist[0]: only the first 4 may differ from zero"),
        ("K", np.zeros((2, 4)), "K[0]: focal lengths must be > 0"),
        ("K", np.full((2, 4), np.nan), "K: must be finite"),
        ("T_rig_cam", mirrored, "T_rig_cam[0]: the 3x3 part has"),
        ("map_size", np.array([0.0]), "map_size: must be > 0"),
        ("map_ids", np.array([], int), "map_size: must have the shape (M), for map_ids has M = 0"),
        ("obj_order", np.zeros((4, 2)), "obj_order: must be"),
        ("K", np.full((2, 4), 1e9), "K[0]: the principal point"),
        ("K", np.full((2, 4), 1e300), "K[0]: the principal point"),
        ("K", np.full((2, 4), 1e-6), "K[0]: the focal length fx must be from"),
        ("map_size", np.array([1e9]), "map_size[0]: must be from 0.001 to 100 m, got 1e+09"),
        ("T_map_tag", np.full((1, 4, 4), 1e300), "T_map_tag[0][0]: must be from"),
        ("dist", np.full((2, 5), 1e9), "dist[0][0]: must be from"),
        ("stamp_ns", np.full(3, 2**62), "stamp_ns[0]: must be from"),
        ("cam_names", np.array(["\x1b[31m"] * 2), "cam_names[0]: must be a name, got '\\x1b[31m'"),
        ("corners_px", backwards, "of 3 detections 3 list their corners the other way round"),
    ]:  # fmt: skip
        changed = {name: one for name, one in arrays().items() if name != key}
        np.savez(path, **changed | ({} if value is None else {key: value}))
        line = refused(path)
        assert line.startswith(f"{path}: {expected}"), line


def test_ids_of_two_families_can_not_be_told_apart(tmp_path, rig):
    entry = {"id": 0, "size_m": 0.2, "T_world_marker": np.eye(4).tolist()}
    markers = [entry | {"family": "tag36h11"}, entry | {"family": "tag25h9"}]
    (tmp_path / "m.yaml").write_text(str({"markers": markers}))
    bag = write_bag(tmp_path / "a.bag", {topic: [(1, [])] for topic in QCAR_TOPICS})
    line = refused(bag, rig, files.load_markers(tmp_path / "m.yaml"))
    assert line.startswith("--markers: ids must differ")
