"""What drives: from what the sensors say to what the car is told."""
