"""Commands that calibrate one's own car: cameras, markers, odometry."""
