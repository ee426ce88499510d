"""Calibration of the odometry's parameters from drives past markers."""
