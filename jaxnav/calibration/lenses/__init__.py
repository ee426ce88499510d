"""A camera of its own: its lens from views of a board."""
