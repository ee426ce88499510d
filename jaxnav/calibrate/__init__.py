"""Calibration of a car's lenses, camera poses, markers and odometry, each with its uncertainty."""
