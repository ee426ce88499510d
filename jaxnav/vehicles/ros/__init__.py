"""A connection to ROS 2, and what is published and listened to there."""
