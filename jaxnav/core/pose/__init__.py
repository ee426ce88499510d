"""From the corners of one instant to candidate poses."""
