"""Values of one frame: pose, detector, sensor, and the conditions it is exposed under."""
