"""The executable of `ros2 run jaxnav_ros node`."""

import jaxnav.ros.node


def main() -> None:
    """Run the node until it is shut down."""
    jaxnav.ros.node.main()
