"""Calibration of the poses of a rig's cameras and of the markers."""
