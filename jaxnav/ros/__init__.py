"""ROS 2: messages to and from our types, and a connection; imported without ROS, JAX or OpenCV."""
