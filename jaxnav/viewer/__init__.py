"""A drive in the Rerun viewer."""
