"""Vehicles and cameras that come with jaxnav: plug-ins like anybody's, see `loop.interfaces`."""
