"""A simulated car behind ROS topics, as a process: python -m tests.real_ros.sim_car.

With --clock it sends /clock, and its stamps are of that: seconds since it began, and 100.

It publishes /odom (with a pose that drifts), /NAME/detections of each camera of the QCar, and the
true pose on /truth; it obeys /drive, and stops by itself 0.5 s after the last command.
"""

import math
import signal
import sys
import threading
import time

from jaxnav.files import calib_dir, load_markers, load_rig, load_route, load_vehicle
from jaxnav.loop.interfaces import Setup
from jaxnav.models.twists import twist_of
from jaxnav.ros.camera_messages import APRILTAG_ROS, detections_message
from jaxnav.ros.connection import Connection, message_type
from jaxnav.ros.lenses import CAMERA_INFO
from jaxnav.ros.odometry_messages import ACKERMANN, NAV_ODOMETRY
from jaxnav.vehicles.sim import open_cameras, open_vehicle

WHEELBASE_M = 0.256
ODOMETRY_S = 0.02
SILENT_S = 0.5


def tell_lenses(ros, rig, over):
    """Publish the camera_info of each camera, five times a second."""
    kind = message_type(CAMERA_INFO)
    topics = [ros.publisher(CAMERA_INFO, f"/{name}/camera_info") for name in rig.names]
    while not over.wait(0.2):
        for c, topic in enumerate(topics):
            camera = rig.camera(c)
            (fx, fy), (cx, cy) = camera.focal_px.tolist(), camera.center_px.tolist()
            width, height = rig.image_sizes_px[c]
            info = kind(width=width, height=height, distortion_model="equidistant")
            info.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
            info.d = camera.distortion.tolist()[:4]
            ros.publish(topic, info)


def main(clocked):
    """Simulate until a signal comes."""
    over = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: over.set())
    qcar = calib_dir() / "qcar"
    rig, route = load_rig(qcar / "rig.yaml"), load_route(qcar / "route.yaml")
    vehicle_model = load_vehicle(qcar / "vehicle.yaml")
    setup = Setup(rig, load_markers(qcar / "markers.yaml"), vehicle_model, route.start_pose)
    vehicle = open_vehicle(setup)
    cameras = open_cameras(setup, vehicle)
    ros = Connection("sim_car")
    per_throttle_mps = float(vehicle_model.speed_per_throttle_mps)
    heard_s = [time.monotonic()]
    began_ns, time_of = time.monotonic_ns(), message_type("builtin_interfaces/msg/Time")

    def stamp_of(now_ns):
        if not clocked:
            return ros.stamp(now_ns)
        since_ns = now_ns - began_ns + 100 * 10**9
        return time_of(sec=since_ns // 10**9, nanosec=since_ns % 10**9)

    def tick():
        clock = message_type("rosgraph_msgs/msg/Clock")
        publisher = ros.publisher("rosgraph_msgs/msg/Clock", "/clock")
        while not over.wait(0.005):
            ros.publish(publisher, clock(clock=stamp_of(time.monotonic_ns())))

    def obey(message):
        heard_s[0] = time.monotonic()
        vehicle.write(message.drive.steering_angle, message.drive.speed / per_throttle_mps)

    def look(camera, publisher):
        while not over.is_set():
            frame = camera.read(0.1)
            if frame is not None:
                stamp = stamp_of(frame.stamp_ns)
                ros.publish(publisher, detections_message(frame.detections, stamp))

    ros.listen(ACKERMANN, "/drive", obey)
    odom = ros.publisher(NAV_ODOMETRY, "/odom")
    truth = ros.publisher("geometry_msgs/msg/PoseStamped", "/truth")
    ros.run()
    if clocked:
        threading.Thread(target=tick, daemon=True).start()
    threading.Thread(target=tell_lenses, args=(ros, rig, over), daemon=True).start()
    for camera in cameras:
        publisher = ros.publisher(APRILTAG_ROS, f"/{camera.name}/detections")
        threading.Thread(target=look, args=(camera, publisher), daemon=True).start()
    x_m = y_m = psi_rad = 0.0
    while not over.wait(ODOMETRY_S):
        if time.monotonic() - heard_s[0] > SILENT_S:
            vehicle.stop()
        reading = vehicle.read()
        slope = math.tan(reading.steering_rad)
        forward_mps, rate_radps = twist_of(reading.speed_mps, reading.steering_rad, WHEELBASE_M)
        psi_rad += rate_radps * ODOMETRY_S
        x_m += reading.speed_mps * math.cos(psi_rad + math.atan(slope / 2)) * ODOMETRY_S
        y_m += reading.speed_mps * math.sin(psi_rad + math.atan(slope / 2)) * ODOMETRY_S
        message = message_type(NAV_ODOMETRY)()
        message.header.stamp = stamp_of(reading.stamp_ns)
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        place(message.pose.pose, x_m, y_m, psi_rad)
        message.twist.twist.linear.x, message.twist.twist.angular.z = forward_mps, rate_radps
        ros.publish(odom, message)
        true = message_type("geometry_msgs/msg/PoseStamped")()
        now_ns = time.monotonic_ns()
        true.header.stamp = stamp_of(now_ns)
        place(true.pose, *map(float, vehicle.world.state(now_ns)[:3]))
        ros.publish(truth, true)
    for camera in cameras:
        camera.close()
    vehicle.close()
    ros.close()


def place(pose, x_m, y_m, psi_rad):
    """Write a planar pose into a message."""
    pose.position.x, pose.position.y = x_m, y_m
    pose.orientation.w, pose.orientation.z = math.cos(psi_rad / 2), math.sin(psi_rad / 2)


if __name__ == "__main__":
    main("--clock" in sys.argv)
