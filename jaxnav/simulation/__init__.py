"""A world to drive in: what cameras, encoders and vehicles would have said."""
