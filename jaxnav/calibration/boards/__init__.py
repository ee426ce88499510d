"""Calibration boards: printed, found in pictures, and told apart."""
