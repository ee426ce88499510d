"""What there is: cameras, rigs, markers, cars, and the frames that they are in."""
