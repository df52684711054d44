"""Before a scan: find the exposure time, and the position of the rotation axis, from a few frames."""

COMMANDS = {
    "tune": ("Take a few frames, and report noise, saturation and the exposure time to use.", True),
    "align": ("Take two opposite projections; report rotation axis, tilt and focus, and how to correct them.", True),
}
