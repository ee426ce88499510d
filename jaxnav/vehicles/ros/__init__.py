"""A connection to ROS 2, and what is published there; imported without ROS, JAX or OpenCV."""
