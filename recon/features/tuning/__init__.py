"""A pair of opposite views: axis, tilt and sharpness."""
