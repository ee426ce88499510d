"""What runs on and around the vehicle: recordings in and out."""
