"""Values for one frame: pose, detector, sensor, and the conditions of its exposure."""
