"""Readers of recordings made by other software."""
