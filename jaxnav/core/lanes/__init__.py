"""Evaluate a function for thousands of lanes, batch axis last, for simulation and tuning."""
