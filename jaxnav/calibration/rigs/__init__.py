"""Where the cameras of a rig and the markers are."""
