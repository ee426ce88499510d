"""Publishers that repeat themselves, whose stamps stand or jump, and that die, over real DDS: the
flags and the throttle of the fault matrix (`vehicles/conformance/matrix.py`), in one drive."""

import signal
import sys
import time

import numpy as np

from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault, Health, names
from jaxnav.files import calib_dir
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.ros import message_type
from jaxnav.recordings.ros.camera_messages import APRILTAG_ROS, detections_message
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY
from tests.real_ros.processes import Program, node, sim_car, until
from tests.real_ros.relay import CAMERAS
from tests.real_ros.test_node_drives import (
    PATIENT,
    Listener,
    answer_of,
    pose_of,
    stamp_s,
    write_file,
)

TEXT = "std_msgs/msg/String"
LASTS_S = 1.6  # a fault; longer than a stamp may be old
SLOW, STALE = Health.DEGRADED, Fault.CAMERAS_STALE | Fault.ODOMETRY_STALE
# What fails and how, the flags it must lead to, and the best health that it may leave.
FAULTS = {
    "odom repeats": (Fault.ODOMETRY_STALE, SLOW),
    "odom stands": (Fault.ODOMETRY_STALE, SLOW),
    "odom jumps": (Fault.STAMP_INVALID, Health.OK),
    "cameras repeats": (Fault.STAMP_INVALID | Fault.CAMERAS_STALE, SLOW),
    "cameras stands": (Fault.STAMP_INVALID | Fault.CAMERAS_STALE, SLOW),
    "cameras jumps": (Fault.STAMP_INVALID, Health.OK),
}
KILLED = STALE, Health.STOP
OTHER_MARKER = """
  - id: 7
    family: tag36h11
    size_m: 0.172
    T_world_marker: [[1, 0, 0, 3], [0, 0, -1, 1.47], [0, 1, 0, 0.2], [0, 0, 0, 1]]
"""


def relay(folder, number: int) -> Program:
    return Program(folder / f"relay{number}.log", sys.executable, "-m", "tests.real_ros.relay")


def test_publishers_that_repeat_jump_and_die(tmp_path):
    topics = ", ".join(f"{name}: /relayed/{name}/detections" for name in CAMERAS)
    file = write_file(tmp_path, cameras=f"{{{topics}}}", odometry="/relayed/odom")
    # The node begins when somebody hears its commands: that must be the car.
    recording, listener = tmp_path / "drive.mcap", Listener("/drive")
    faults = listener.connection.publisher(TEXT, "/fault")
    happened: dict[str, tuple[int, int]] = {}

    def is_well() -> bool:
        bank = listener.last("/jaxnav/bank")
        return bool(bank and bank.health == "OK" and bank.decided)

    def states() -> str:
        """What the node said last: a health and its flags for each second or so."""
        banks = listener.heard["/jaxnav/bank"][::-30][:20]
        return "; ".join(f"{one.health} {'+'.join(one.faults)} {one.decided}" for one in banks)

    def is_on_its_way() -> bool:
        """A car that has hardly begun to move may be taken for one that can't."""
        way = [pose_of(one.pose)[4:6] for one in listener.heard["/truth"]]
        return bool(way) and float(np.linalg.norm(way[-1] - way[0])) > 0.3

    def lasts(name: str) -> None:
        begin_ns = time.monotonic_ns()
        time.sleep(LASTS_S)
        happened[name] = begin_ns, time.monotonic_ns()

    try:
        words = (*PATIENT, "--record", str(recording))
        with sim_car(tmp_path), node(tmp_path, str(file), *words) as program:
            with relay(tmp_path, 1) as dies:
                until(lambda: is_well() and is_on_its_way(), 240.0, program, states)
                for name in FAULTS:
                    tell(listener, faults, name)
                    lasts(name)
                    tell(listener, faults, f"{name.split()[0]} passes")
                    time.sleep(0.3)
                    until(is_well, 30.0, program, states)
                dies.tell(signal.SIGKILL)
                lasts("killed")
            with relay(tmp_path, 2):
                until(is_well, 30.0, program, states)
                program.tell(signal.SIGTERM)
                assert program.ends() == 128 + signal.SIGTERM, program.said
    finally:
        listener.connection.close()
    outcomes = read_drive(recording).outcomes
    for name, (flags, health) in (FAULTS | {"killed": KILLED}).items():
        begin_ns, end_ns = happened[name]
        within = (outcomes.now_ns > begin_ns) & (outcomes.now_ns < end_ns)
        seen = Fault(0)
        for flag in np.asarray(outcomes.faults)[within]:
            seen |= Fault(int(flag))
        assert flags in seen, (name, seen)
        healths = [Health(int(one)) for one in np.asarray(outcomes.health)[within]]
        assert max(healths) >= health, (name, set(healths))
        full = 0.3
        for one, throttle in zip(healths, np.asarray(outcomes.throttle)[within], strict=True):
            most = {Health.STOP: 0.0, SLOW: 0.5 * full}.get(one, full)
            assert abs(throttle) <= most + 1e-6, (name, one)
    first_ns = min(begin_ns for begin_ns, _ in happened.values())
    check_errors(listener, (first_ns + time.time_ns() - time.monotonic_ns()) / 1e9)


def test_nothing_that_is_sent_ends_it_and_a_map_that_is_refused_changes_nothing(tmp_path):
    """Numbers that no vehicle has on every topic, and services that are asked for nonsense."""
    listener = Listener()
    ros = listener.connection
    load = "jaxnav_msgs/srv/LoadMarkers", "/jaxnav/load_markers"
    markers = (calib_dir() / "qcar/markers.yaml").read_text()
    (tmp_path / "two.yaml").write_text(markers + OTHER_MARKER)
    (tmp_path / "bad.yaml").write_text(markers.replace("size_m", "size"))
    odometry = ros.publisher(NAV_ODOMETRY, "/odom")
    seen = [ros.publisher(APRILTAG_ROS, f"/{name}/detections") for name in CAMERAS]
    absurd = Fault.ODOMETRY_INVALID | Fault.CORNERS_NOT_FINITE

    def send(value: float) -> None:
        ros.publish(odometry, absurd_odometry(value, ros))
        for publisher in seen:
            ros.publish(publisher, absurd_detections(value, ros))
        time.sleep(0.02)

    def all_is_noted() -> bool:
        """What is sent is lost on a busy machine where the car's own comes right after it."""
        send(np.nan)
        noted = {name for bank in listener.heard["/jaxnav/bank"] for name in bank.faults}
        return noted >= set(names(absurd))

    try:
        words = (str(write_file(tmp_path)), *PATIENT, "--record", str(tmp_path / "drive.mcap"))
        with sim_car(tmp_path), node(tmp_path, *words) as program:
            until(listener.drives, 240.0, program)
            listener.forget()
            for value in (1e308, -1e30, 1e9, np.inf, np.nan) * 5:
                send(value)
            until(all_is_noted, 30.0, program)
            until(listener.drives, 30.0, program)
            # Refused: it drives on, in the map that it had.
            restarts = listener.last("/jaxnav/bank").restarts
            listener.forget()
            for path in ("none.yaml", "bad.yaml", "x" * 100_000, ""):
                answer = answer_of(listener, *load, {"path": path})
                assert not answer.success, path[:20]
                assert len(answer.message) < 1100
            assert not answer_of(
                listener, "jaxnav_msgs/srv/Save", "/jaxnav/save", {"folder": "x" * 100_000}
            ).success
            until(lambda: listener.heard["/jaxnav/bank"], 10.0, program)
            assert all(bank.located for bank in listener.heard["/jaxnav/bank"])
            assert listener.last("/jaxnav/bank").restarts == restarts
            # Accepted: it drives on until all is compiled, then in the new map.
            begun_anew = answer_of(listener, *load, {"path": "two.yaml"})
            assert begun_anew.success, begun_anew.message
            listener.forget()
            until(listener.decided, 60.0, program)
            assert "ended" not in program.said
            assert "Traceback" not in program.said
            program.tell(signal.SIGTERM)
            assert program.ends() == 128 + signal.SIGTERM, program.said
    finally:
        ros.close()
    seen_faults = Fault(0)
    for flag in np.asarray(read_drive(tmp_path / "drive.mcap").outcomes.faults):
        seen_faults |= Fault(int(flag))
    assert absurd in seen_faults


def absurd_odometry(value: float, ros):
    """A nav_msgs/Odometry of now, all of whose numbers are this one."""
    message = message_type(NAV_ODOMETRY)()
    message.header.stamp = ros.stamp(ros.now_ns())
    pose, twist = message.pose.pose, message.twist.twist
    for part in (pose.position, pose.orientation, twist.linear, twist.angular):
        for axis in part.get_fields_and_field_types():
            setattr(part, axis, value)
    return message


def absurd_detections(value: float, ros):
    """A detection of the map's marker all of whose corners are there."""
    found = Detections(
        np.zeros(1, int),
        np.full((1, 4, 2), value),
        np.ones((1, 4)),
        np.ones(1, bool),
        ("tag36h11",),
    )
    return detections_message(found, ros.stamp(ros.now_ns()))


def tell(listener: Listener, publisher, text: str) -> None:
    listener.connection.publish(publisher, message_type(TEXT)(data=text))


def check_errors(listener: Listener, begin_s: float) -> None:
    """No pose is farther off than the matrix allows, but for those before the first fault whose
    covariance says so: the first poses of a start are known to a decimetre.

    Args:
        begin_s: when the first fault began, on the clock of the stamps.
    """
    times_s = np.array([stamp_s(one) for one in listener.heard["/truth"]])
    for message in listener.heard["/jaxnav/pose"]:
        true = listener.heard["/truth"][int(np.argmin(np.abs(times_s - stamp_s(message))))]
        error_m = (pose_of(message.pose.pose) - pose_of(true.pose))[4:6]
        covariance = np.asarray(message.pose.covariance).reshape(6, 6)[:2, :2]
        honest = error_m @ np.linalg.solve(covariance, error_m) < 30.0  # one in three millions
        assert np.linalg.norm(error_m) < 0.15 or (honest and stamp_s(message) < begin_s)
