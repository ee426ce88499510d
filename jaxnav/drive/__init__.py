"""The driving loop: from sensor data to the car's commands."""
