"""The executable of `ros2 run jaxnav_ros node`: `jaxnav ros --managed`, with ROS's own words."""

import sys

from jaxnav.cli import main as jaxnav


def main() -> int:
    """Run the node until a signal ends it; returns the exit code."""
    return jaxnav(["ros", "--managed", *sys.argv[1:]])
