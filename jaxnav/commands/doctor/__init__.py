"""What a car will run with, looked at."""
