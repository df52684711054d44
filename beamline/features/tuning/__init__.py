"""Before a scan: which exposure to take, and how the axis lies, by a few frames."""

COMMANDS = {
    "tune": ("Take a few frames and say which exposure to take.", True),
    "align": ("Take a pair of views and say axis, tilt and sharpness, with the corrections.", True),
}
