"""Publishers that repeat themselves, whose stamps stand or jump, and that die, over real DDS: the
flags and the throttle of the fault matrix (`jaxnav/testing/matrix.py`), in one drive."""

import signal
import sys
import time

import numpy as np

from jaxnav.loop.flags import Fault, Health
from jaxnav.recording.drive_log import read_drive
from jaxnav.ros.connection import message_type
from tests.real_ros.processes import Program, node, sim_car, until
from tests.real_ros.relay import CAMERAS
from tests.real_ros.test_node_drives import PATIENT, Listener, pose_of, stamp_s, write_file

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
