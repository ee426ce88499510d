"""Our own drives: recorded, read back and replayed."""
