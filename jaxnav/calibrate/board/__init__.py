"""Calibration boards: their layout, their printed sheet and their detection in images."""
