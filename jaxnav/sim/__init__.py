"""Simulate cameras, encoders and vehicles: the measurements they would have delivered."""
