"""Checks of what a car will run with: `jaxnav doctor`."""
