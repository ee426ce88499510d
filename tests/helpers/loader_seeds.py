"""Every loader of jaxnav with a file that it reads: the beginning of all damage."""

import bz2
import dataclasses
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from jaxnav import files
from jaxnav.commands.simulate import simulate
from jaxnav.commands.simulate.arguments import Simulate
from jaxnav.commands.study.study import load_study, summary_of
from jaxnav.core.models.rig import CameraRig, Timing
from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import parameters_of
from jaxnav.experiments.studies.store import open_store
from jaxnav.files.cameras import camera_file
from jaxnav.files.images import read_image
from jaxnav.files.kalibr import names_by_topic
from jaxnav.files.markers import marker_map
from jaxnav.files.poses import pose_as_read
from jaxnav.files.reading import read_mapping
from jaxnav.files.ros import load_ros
from jaxnav.files.wpilib import layout_left_out, layout_markers
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.recordings import read_recording
from jaxnav.recordings.other.ros import read_ros_drive
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import input_message, outcome_message
from jaxnav.sim.bases import equipped
from tests.helpers.drives import make_base_input, make_outcome, record_drive
from tests.helpers.ros_bags import FORMATS, Bag
from tests.helpers.ros_drives import BEGIN_NS, IMU, MS, SQUARE_PX, TOPICS
from tests.helpers.ros_drives import drive as ros_drive
from tests.helpers.seed_texts import (
    AMBIGUITY,
    CAMERA_INFO,
    DRIVE,
    KALIBR,
    OPENCV,
    PARAMS,
    PHOTONVISION,
    SIMULATED,
    SPHERES,
    STUDY,
    TAGSLAM,
    WPILIB,
)
from tests.helpers.simulated import make_setup
from tests.worlds import qcar, qcar_rig, room_markers

QCAR = files.calib_dir() / "qcar"


@dataclass(frozen=True)
class Loader:
    """What reads a file, and such a file.

    Attributes:
        make: writes the file, and what it refers to, into a folder that is empty.
        load: reads all of it, from the path that `make` gave.
    """

    make: Callable[[Path], Path]
    load: Callable[[Path], Any]


def _written(name: str, content: str | bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return make


def _saved(name: str, save: Callable[[Path, Any], None], thing: Callable[[], Any]) -> Any:
    def make(folder: Path) -> Path:
        save(folder / name, thing())
        return folder / name

    return make


def _tagslam(name: str) -> Loader:
    def make(folder: Path) -> Path:
        for other, text in TAGSLAM.items():
            (folder / other).write_text(text)
        _seen_bag("bag", "/a/tags").write(folder)
        return folder / name

    return Loader(make, lambda path: read_recording(path.parent))


def _seen_bag(kind: str, *topics: str) -> Bag:
    """Two frames of each camera."""
    bag = Bag(kind)
    for topic in topics:
        for index in range(2):
            t = BEGIN_NS + 30 * index * MS
            bag.tagslam(topic, t, t, [(3, SQUARE_PX), (4, SQUARE_PX + 50)])
    return bag


CAMERAS = ("front", "right", "rear", "left")


def _bag(folder: Path) -> Path:
    return _seen_bag("bag", *CAMERAS).write(folder)


def _compressed_bag(folder: Path) -> Path:
    plain = _bag(folder)
    path = folder / "drive.bag.bz2"
    path.write_bytes(bz2.compress(plain.read_bytes()))
    plain.unlink()
    return path


def _from_bag(path: Path) -> Any:
    return read_recording(path, qcar_rig(), room_markers())


def _ros(kind: str, which: str) -> Loader:
    def make(folder: Path) -> Path:
        (folder / "topics.yaml").write_text(TOPICS)
        path = ros_drive(kind).write(folder)
        return path if path.is_file() else next(path.glob(which))

    def load(path: Path) -> Any:
        folder = path.parent if kind == "bag" else path.parent.parent
        topics = files.load_topics(folder / "topics.yaml")
        bag = path if kind == "bag" else path.parent
        return read_ros_drive(bag, topics, qcar_rig(), room_markers(), qcar())

    return Loader(make, load)


def _decoded(folder: Path) -> Path:
    eye = np.eye(4)
    np.savez(
        folder / "decoded.npz",
        stamp_ns=np.array([10, 10, 20]),
        cam=np.array([0, 1, 1]),
        tag_id=np.array([3, 3, 9]),
        corners_px=np.tile(SQUARE_PX, (3, 1, 1)),
        cam_names=np.array(["a", "b"]),
        K=np.array([[400.0, 400, 320, 240]] * 2),
        dist=np.zeros((2, 5)),
        dist_model=np.array(["equidistant", "none"]),
        T_rig_cam=np.stack([eye, eye]),
        map_ids=np.array([3]),
        map_size=np.array([0.2]),
        T_map_tag=eye[None],
        rig_stamp=np.array([20, 10]),
        T_map_rig=np.stack([eye, eye]),
    )
    return folder / "decoded.npz"


def _drive(folder: Path) -> Path:
    recorder = Recorder(folder / "drive.mcap", make_setup().header())
    record_drive(recorder, 12)
    recorder.close()
    return recorder.path


def _base_drive(folder: Path) -> Path:
    """Twists and turn rates, and what the pilot made of them."""
    base = equipped(qcar(), "omni", "consumer")
    setup = dataclasses.replace(make_setup(), vehicle=base)
    recorder = Recorder(folder / "drive.mcap", setup.header())
    for index in range(6):
        given = make_base_input(index)
        recorder.put(*input_message(given))
        outcome = dataclasses.replace(make_outcome(index), twist=(0.1 * index, -0.2, 0.3))
        recorder.put("/outcome", given.now_ns, outcome_message(outcome))
    recorder.close()
    return recorder.path


def _whole_drive(path: Path) -> Any:
    """All that a command reads of it."""
    log = read_drive(path)
    return log, DriveSetup.from_header(log.header, path), list(log.images())


STORED = ("zarr.json", "done/zarr.json", "done/c/0/0", "outcome/zarr.json", "outcome/c/0/0/0")


def _stored(which: str) -> Loader:
    """A file of a study's store."""

    def make(folder: Path) -> Path:
        (folder / "study.yaml").write_text(STUDY)
        study = load_study("ambiguity", folder / "study.yaml")
        store = open_store(folder / "s.zarr", study)
        rng = np.random.default_rng(0)
        for box in list(store.missing()):
            *outer, trials = (part.stop - part.start for part in store.layout.region(box))
            found = {}
            for name, variable in study.schema.variables.items():
                inner = (2,) if variable.of_selector else ()
                most = len(variable.outcomes) or 2
                numbers = rng.uniform(0, most, (math.prod(outer), *inner, trials))
                found[name] = numbers.astype(variable.dtype)
            store.write(box, found)
        return store.path / which

    def load(path: Path) -> Any:
        """As `jaxnav plot` and as `jaxnav study` that goes on."""
        folder = path
        while folder.name != "s.zarr":
            folder = folder.parent
        bar = SimpleNamespace(reset=lambda total: None, update=lambda done: None)
        kind, done, _ = summary_of(folder, bar)
        study = load_study("ambiguity", folder.parent / "study.yaml")
        store = open_store(folder, study)
        assert (kind, done + 12 * len(list(store.missing()))) == ("ambiguity", 12)
        return None

    return Loader(make, load)


def _resumed(path: Path) -> None:
    """As `jaxnav simulate --resume`."""
    simulate._resumed(Simulate(json=path, resume=True))


def _applied(path: Path) -> Any:
    """What a car takes from a file of tuned parameters."""
    params = files.load_params(path)
    assert params.describe().isprintable()
    car = Navigator(qcar_rig(), room_markers(), qcar(), [(0.0, 0.0)])
    taken = parameters_of(files.apply_params(car, params))
    return {name: taken[name] for name in params.values}


def _picture(extension: str) -> Callable[[Path], Path]:
    pixels = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)
    return _written(f"photo{extension}", cv2.imencode(extension, pixels)[1].tobytes())


def _layout(path: Path) -> Any:
    """A WPILib field layout as a map of ours."""
    data = read_mapping(path)
    markers = layout_markers(path, data)
    assert all(isinstance(key, str) for key in layout_left_out(data))
    return marker_map(
        np.stack([pose_as_read(marker.T_world_marker) for marker in markers]),
        [marker.size_m for marker in markers],
        [marker.id for marker in markers],
        [marker.family for marker in markers],
    )


def _cameras(path: Path) -> Any:
    """All cameras of a file, as `jaxnav calibrate convert` takes them."""
    data = read_mapping(path)
    file = camera_file(path, data, names_by_topic)
    assert all(isinstance(key, str) for key in file.left_out)
    return [camera.camera() for camera in file.cameras]


ROS_NODE = f"""
rig: rig.yaml
markers: markers.yaml
vehicle: vehicle.yaml
{TOPICS}
odometry_type: sensor_msgs/msg/JointState
joints: {{driven: [rear], steered: [front], wheel_radius_m: 0.03}}
command_type: twist
frames: {{map: world, base: car}}
base_x_m: -0.128
camera_info: {{front: /front/camera_info}}
rectified: false
tf_tolerance_s: 0.1
"""
ROS_BASE = """
rig: rig.yaml
markers: markers.yaml
vehicle: base.yaml
cameras: {front: /front/detections}
odometry: /odom
imu: {topic: /imu, T_vehicle_imu: {wxyz: [0, 1, 0, 0], xyz_m: [0.1, 0, -0.2]}}
command: /cmd_vel
command_type: twist
"""
BASE = """
base: omni
forward_limit_mps: 1.0
left_limit_mps: 0.5
turn_limit_radps: 4.0
time_constant_s: 0.15
sigma: {speed_scale: 0.01, turn_gain: 0.02}
gyro: {class: tactical, delay_s: 0.004}
resume: true
"""
ROS_BODY = """
rig: rig.yaml
markers: markers.yaml
cameras: {front: /front/detections}
odometry: /vio/odom
T_vehicle_odometry: {wxyz: [0, 0, 0, 1], xyz_m: [0.1, 0, -0.2]}
odometry_delay_s: -0.05
odometry_sigma: {scale: 0.05, turn_deg: 2.0}
"""


def _timed_rig() -> CameraRig:
    rig = qcar_rig()
    return dataclasses.replace(rig, timings=(Timing(0.008, 1.5e-5),) * len(rig))


STRUCTURED = {
    "rig": Loader(_written("rig.yaml", (QCAR / "rig.yaml").read_bytes()), files.load_rig),
    "saved rig": Loader(_saved("rig.yaml", files.save_rig, _timed_rig), files.load_rig),
    "markers": Loader(
        _written("markers.yaml", (QCAR / "markers.yaml").read_bytes()), files.load_markers
    ),
    "saved markers": Loader(
        _saved("markers.yaml", files.save_markers, room_markers), files.load_markers
    ),
    "vehicle": Loader(
        _written("vehicle.yaml", (QCAR / "vehicle.yaml").read_bytes()), files.load_vehicle
    ),
    "vehicle of another base": Loader(_written("vehicle.yaml", BASE), files.load_vehicle),
    "route": Loader(_written("route.yaml", (QCAR / "route.yaml").read_bytes()), files.load_route),
    "params": Loader(_written("params.yaml", PARAMS), _applied),
    "topics": Loader(_written("topics.yaml", TOPICS), files.load_topics),
    "topics with an IMU": Loader(_written("topics.yaml", TOPICS + IMU), files.load_topics),
    "ROS node": Loader(_written("node.yaml", ROS_NODE), load_ros),
    "ROS node of a base": Loader(_written("node.yaml", ROS_BASE), load_ros),
    "ROS node of a free rig": Loader(_written("node.yaml", ROS_BODY), load_ros),
    "Kalibr rig": Loader(_written("chain.yaml", KALIBR), files.load_rig),
    "Kalibr camera": Loader(
        _written("chain.yaml", KALIBR), lambda path: files.load_camera(path, "cam1")
    ),
    "Kalibr spheres": Loader(_written("chain.yaml", SPHERES), _cameras),
    "Kalibr chain": Loader(_written("chain.yaml", KALIBR), _cameras),
    "WPILib": Loader(_written("layout.json", WPILIB), _layout),
    "camera_info": Loader(_written("camera.yaml", CAMERA_INFO), files.load_camera),
    "OpenCV": Loader(_written("camera.yml", OPENCV), files.load_camera),
    "PhotonVision": Loader(_written("camera.json", PHOTONVISION), files.load_camera),
    "ambiguity study": Loader(
        _written("study.yaml", AMBIGUITY), lambda path: load_study("ambiguity", path)
    ),
    "drive study": Loader(_written("study.yaml", DRIVE), lambda path: load_study("drive", path)),
    **{f"TagSLAM {name}": _tagslam(name) for name in TAGSLAM},
    "simulation": Loader(_written("s.json", json.dumps(SIMULATED)), _resumed),
}
BINARY = {
    "drive": Loader(_drive, _whole_drive),
    "drive of a base": Loader(_base_drive, _whole_drive),
    "bag": Loader(_bag, _from_bag),
    "compressed bag": Loader(_compressed_bag, _from_bag),
    **{f"ROS {kind}": _ros(kind, f"*.{kind}") for kind in FORMATS},
    "ROS metadata": _ros("db3", "metadata.yaml"),
    **{f"store {which}": _stored(which) for which in STORED},
    "arrays": Loader(_decoded, read_recording),
    **{extension: Loader(_picture(extension), read_image) for extension in (".png", ".jpg")},
}
