"""Programs that are compiled once on a machine, and kept."""
