"""Models of cameras, rigs, markers and cars, and the frames they are in."""
