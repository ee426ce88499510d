"""Boards, lenses, extrinsics, markers and odometry of one's own car, each with its uncertainty."""
