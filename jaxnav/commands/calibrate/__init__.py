"""The figures of one's own car."""
