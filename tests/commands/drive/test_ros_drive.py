"""The node of ROS 2 without ROS: what its file may ask for, and what its service `~/save` writes.

Those are the files that `calibrate adopt` makes of the same drive's recording.
"""

import dataclasses

import pytest
import yaml

from jaxnav.commands.drive.ros_drive import LearntKeeper, check_vehicle
from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput
from jaxnav.files import load_rig, load_vehicle, save_rig, save_vehicle
from jaxnav.files.ros import load_ros
from jaxnav.recordings.drive_setup import DriveSetup
from tests import worlds
from tests.commands.calibrate.test_adopt import adopt, learnt_outcome, record, setup_of
from tests.helpers import late

NAMES = ("rig", "vehicle")
NODE = """\
rig: rig.yaml
vehicle: vehicle.yaml
markers: markers.yaml
cameras: {front: /front/detections}
odometry: /odom
"""
IMU = "imu: {topic: /imu, T_vehicle_imu: {wxyz: [0, 1, 0, 0], xyz_m: [0, 0, 0]}}\n"


def content(path):
    """What a file holds beside its provenance, which it must have."""
    held = yaml.safe_load(path.read_text())
    assert held.pop("calibrated")["tool"].startswith("jaxnav ")
    return held


def rounded(value):
    """Content that equals what differs by the rounding of a recording."""
    if isinstance(value, dict):
        return {key: rounded(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [rounded(inner) for inner in value]
    return pytest.approx(value, rel=1e-7, abs=1e-8) if isinstance(value, float) else value


@pytest.fixture
def folder(tmp_path):
    """The node's file with rig and vehicle as they are driven with."""
    setup = setup_of()
    save_rig(tmp_path / "rig.yaml", setup.rig)
    save_vehicle(tmp_path / "vehicle.yaml", setup.vehicle)
    (tmp_path / "node.yaml").write_text(NODE)
    (tmp_path / "new").mkdir()
    return tmp_path


def keeper_of(folder, outcomes, setup: DriveSetup | None = None) -> LearntKeeper:
    keeper = LearntKeeper(load_ros(folder / "node.yaml"), setup or setup_of())
    for outcome in outcomes:
        keeper.on_outcome(Input(outcome.now_ns), outcome)
    return keeper


def test_it_writes_what_adopt_makes_of_the_recording(folder):
    outcomes = [learnt_outcome(index, decided=index < 10) for index in range(12)]
    keeper = keeper_of(folder, outcomes)
    keeper.warm_up()
    with late.watching():  # the node drives meanwhile
        said = keeper.save("new")
    assert said.startswith(f"rig.yaml, vehicle.yaml in {folder / 'new'}: camera ")
    assert "looks 1.20 deg too far left" in said
    recording = record(folder / "drive.mcap", outcomes)
    files = [f"--{name}={folder / name}.yaml" for name in NAMES]
    assert adopt(recording, *files, "--out", folder / "adopted") == 0
    for name in ("rig.yaml", "vehicle.yaml"):
        assert content(folder / "new" / name) == rounded(content(folder / "adopted" / name))
    assert load_rig(folder / "new/rig.yaml").extrinsics_sigma is not None
    assert load_vehicle(folder / "new/vehicle.yaml").camera_delay_s == pytest.approx(0.022)


def test_a_vehicle_that_is_exact_is_not_written(folder):
    exact = dataclasses.replace(setup_of().vehicle, sensor_sigma=None)
    setup = dataclasses.replace(setup_of(), vehicle=exact)
    said = keeper_of(folder, [learnt_outcome(9)], setup).save(str(folder / "new"))
    assert said.startswith(f"rig.yaml in {folder / 'new'}: ")
    assert [path.name for path in (folder / "new").iterdir()] == ["rig.yaml"]


@pytest.mark.parametrize(
    ("outcomes", "name", "expected"),
    [
        ([], "new", "save: the drive never was sure of a pose"),
        ([learnt_outcome(3, decided=False)], "new", "save: the drive never was sure of a pose"),
        ([learnt_outcome(3, learnt=False)], "new", "save: the drive tells no errors"),
        ([learnt_outcome(3)], "none", "save: there is no folder {folder}/none"),
        ([learnt_outcome(3)], ".", "{folder}/rig.yaml: is there already"),
    ],
)
def test_where_it_can_not_one_line_says_why_and_nothing_is_written(
    folder, outcomes, name, expected
):
    before = {path: path.read_bytes() for path in folder.glob("*.yaml")}
    with pytest.raises(BadInput) as refused:
        keeper_of(folder, outcomes).save(name)
    assert str(refused.value).startswith(expected.format(folder=folder))
    assert {path: path.read_bytes() for path in folder.glob("**/*.yaml")} == before


def test_of_two_files_one_that_is_there_keeps_the_other_away(folder):
    (folder / "new/vehicle.yaml").write_text("mine\n")
    with pytest.raises(BadInput, match=r"vehicle\.yaml: is there already"):
        keeper_of(folder, [learnt_outcome(9)]).save("new")
    assert [path.name for path in (folder / "new").iterdir()] == ["vehicle.yaml"]
    assert (folder / "new/vehicle.yaml").read_text() == "mine\n"


@pytest.mark.parametrize("name", NAMES)
def test_a_file_that_was_changed_since_is_not_corrected(folder, name):
    keeper, path = keeper_of(folder, [learnt_outcome(9)]), folder / f"{name}.yaml"
    if name == "rig":
        path.write_text(path.read_text().replace("name: front", "name: bow"))
    else:
        save_vehicle(path, dataclasses.replace(setup_of().vehicle, speed_scale=1.2))
    with pytest.raises(BadInput, match=f"{name}.yaml: has other"):
        keeper.save("new")
    assert not list((folder / "new").iterdir())


def node(tmp_path, text):
    path = tmp_path / "node.yaml"
    path.write_text(NODE + text)
    return load_ros(path)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (
            "odometry_type: ackermann_msgs/msg/AckermannDriveStamped\n",
            "odometry_type: of a base that is no car must be one of nav_msgs/msg/Odometry, ",
        ),
        ("command_type: ackermann\n", "command_type: of a base that is no car must be twist"),
        ("base_x_m: 0.1\n", "base_x_m: of a base that is no car must be 0"),
        (IMU, "imu: vehicle.yaml has no gyro"),
    ],
)
def test_a_node_refuses_what_does_not_go_with_its_vehicle(tmp_path, text, line):
    with pytest.raises(BadInput) as caught:
        check_vehicle(node(tmp_path, text), TwistBase.create(1.0, 3.0, 0.1))
    assert str(caught.value).startswith(f"{tmp_path / 'node.yaml'}: {line}")


def test_a_node_tells_its_plug_in_what_the_file_says(tmp_path):
    file = node(tmp_path, IMU + "command_type: twist\n")
    check_vehicle(file, TwistBase.create(1.0, 3.0, 0.1, gyro=GYROS["consumer"]))
    check_vehicle(node(tmp_path, ""), worlds.qcar())
    options = file.options(drives=True, sim_time=False)
    assert (options["imu_topic"], options["command_type"]) == ("/imu", "twist")
    axis = [float(part) for part in options["imu_axis"].split(",")]
    assert axis == pytest.approx([0.0, 0.0, -1.0], abs=1e-12)  # mounted upside down
    assert "command_topic" not in options
    assert file.options(drives=False, sim_time=False)["command_type"] == "none"
    # Left out, the plug-in knows by the vehicle what is sent.
    assert "command_type" not in node(tmp_path, "").options(drives=True, sim_time=False)
    (tmp_path / "node.yaml").write_text(NODE.replace("vehicle: vehicle.yaml\n", "") + IMU)
    with pytest.raises(BadInput, match="imu needs a vehicle"):
        load_ros(tmp_path / "node.yaml")
