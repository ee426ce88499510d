"""The vehicles and cameras of jaxnav: plug-ins like any other, see `jaxnav.drive.interfaces`."""
