"""jaxnav among the packages of ROS 2: all that it does is in jaxnav.vehicles.ros."""
