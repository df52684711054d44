"""Tango: the running scan as a Tango device."""

COMMANDS = {
    "tango": ("Serve the running scan as a Tango device.", False),
}
