"""Simulated cars."""
