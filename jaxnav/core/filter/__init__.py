"""Choice of a candidate, and the filter that takes it."""
