"""Show a drive in the Rerun viewer."""
