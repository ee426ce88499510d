"""What `jaxnav doctor` looks at, a file for each part of the car."""
