"""Compile programs once on a machine, and keep their executables."""
