"""Demonstration: a simulated scan with live reconstruction, compared with the ground truth."""

COMMANDS = {
    "demo": ("Scan and reconstruct a simulated battery, in about a minute; nothing has to be set up.", True),
}
