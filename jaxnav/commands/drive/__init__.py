"""A car that drives, and recorded drives."""
