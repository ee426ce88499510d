"""Calibration of one camera's lens from views of a board."""
