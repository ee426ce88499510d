"""Time from a camera's stamp until others hear the transform, over ROS 2 on one machine.

    .venv-ros/bin/python benchmarks/bench_ros.py --seconds 60

Four cameras send the corners of one marker at 30 Hz, all at once and as soon as they are stamped;
odometry comes at 50 Hz; the car stands. Another process, this one, hears /tf: for each frame, the
first transform that is stamped later than it. The node's loop looks for odometry every 0.1 s, so
that few transforms are due to anything but frames. Memory is that of node and guard together.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from jaxnav.detection.types import Detections
from jaxnav.files import calib_dir
from jaxnav.recordings.ros import message_type
from jaxnav.recordings.ros.camera_messages import APRILTAG_ROS, detections_message
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY
from jaxnav.vehicles.ros.connection import Connection

FRONT_PX = np.array([[365.9, 170.4], [385.4, 168.8], [385.4, 195.1], [365.8, 195.5]])
CAMERAS = ("front", "right", "rear", "left")
WARM_S = 5.0  # not counted
JAXNAV = (sys.executable, "-c", "import sys; from jaxnav.cli import main; sys.exit(main())")


def file_in(folder: Path) -> Path:
    """The node's file."""
    qcar = calib_dir() / "qcar"
    lines = [f"{name}: {qcar / name}.yaml" for name in ("rig", "markers", "vehicle")]
    topics = ", ".join(f"{name}: /{name}/detections" for name in CAMERAS)
    path = folder / "node.yaml"
    path.write_text("\n".join([*lines, f"cameras: {{{topics}}}", "odometry: /odom", ""]))
    return path


def memory_mb(group: int) -> float:
    """Resident memory of a process group."""
    table = subprocess.run(["ps", "-eo", "pgid=,rss="], capture_output=True, text=True, check=True)
    rows = (line.split() for line in table.stdout.splitlines())
    return sum(int(rss) for pgid, rss in rows if int(pgid) == group) / 1024


def main() -> None:
    """Print one row."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    seconds = parser.parse_args().seconds
    with tempfile.TemporaryDirectory() as folder:
        words = (*JAXNAV, "ros", str(file_in(Path(folder))), "--period-s", "0.1")
        with subprocess.Popen(words, start_new_session=True) as process:
            try:
                measured(seconds, process.pid)
            finally:
                process.terminate()


def measured(seconds: float, group: int) -> None:
    """Send frames and hear transforms."""
    ros = Connection("bench_ros", ros_time=True)
    heard: list[tuple[int, int]] = []  # stamp, arrival
    told: dict[str, str] = {}

    def hear(message: object) -> None:
        stamp = message.transforms[0].header.stamp
        heard.append((stamp.sec * 10**9 + stamp.nanosec, ros.now_ns()))

    def read(message: object) -> None:
        told.update({pair.key: pair.value for pair in message.status[0].values})

    ros.listen("tf2_msgs/msg/TFMessage", "/tf", hear)
    ros.listen("diagnostic_msgs/msg/DiagnosticArray", "/diagnostics", read)
    cameras = [ros.publisher(APRILTAG_ROS, f"/{name}/detections") for name in CAMERAS]
    odom = ros.publisher(NAV_ODOMETRY, "/odom")
    ros.run()
    over = threading.Event()

    def wheels() -> None:
        while not over.wait(0.02):
            message = message_type(NAV_ODOMETRY)()
            message.header.stamp = ros.stamp(ros.now_ns())
            ros.publish(odom, message)

    threading.Thread(target=wheels, daemon=True).start()
    rng = np.random.default_rng(0)
    nothing, sent = Detections.concatenate([]), []
    while not heard:
        frames(ros, cameras, rng, nothing)
        time.sleep(1 / 30)
    begin_s, first_mb = time.monotonic(), 0.0
    while time.monotonic() - begin_s < seconds + WARM_S:
        stamp_ns = frames(ros, cameras, rng, nothing)
        if time.monotonic() - begin_s > WARM_S:
            sent.append(stamp_ns)
            first_mb = first_mb or memory_mb(group)
        time.sleep(1 / 30)
    last_mb = memory_mb(group)
    over.set()
    time.sleep(0.5)
    ros.close()
    stamps_ns, arrivals_ns = (np.array(part) for part in zip(*heard, strict=True))
    after = np.searchsorted(stamps_ns, np.array(sent), side="right")
    sent, after = np.array(sent)[after < len(heard)], after[after < len(heard)]
    late_ms = (arrivals_ns[after] - sent) / 1e6
    print(
        "| cores | frames | stamp to tf heard, median ms | 99 % | node's own: median | 99 % | MB |"
    )
    print("|---|---|---|---|---|---|---|")
    print(
        f"| {os.cpu_count()} | {len(sent)} | {np.median(late_ms):.2f} "
        f"| {np.percentile(late_ms, 99):.2f} | {told['camera_to_tf_ms']} "
        f"| {told['camera_to_tf_99_ms']} | {first_mb:.0f} -> {last_mb:.0f} |"
    )


def frames(ros: Connection, cameras: list, rng: np.random.Generator, nothing: Detections) -> int:
    """Send a frame of each camera, of which the first shows the marker; return their stamp."""
    corners_px = FRONT_PX + 0.1 * rng.standard_normal((4, 2))
    found = Detections(
        np.array([0]), corners_px[None], np.full((1, 4), 0.3), np.ones(1, bool), ("tag36h11",)
    )
    now_ns = ros.now_ns()
    for camera, publisher in enumerate(cameras):
        ros.publish(publisher, detections_message(nothing if camera else found, ros.stamp(now_ns)))
    return now_ns


if __name__ == "__main__":
    main()
