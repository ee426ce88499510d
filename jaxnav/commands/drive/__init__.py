"""Commands for a car that drives, and for recorded drives."""
