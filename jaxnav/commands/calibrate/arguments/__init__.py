"""What `jaxnav calibrate` can be told: one file for each of its commands."""
