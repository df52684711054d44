"""Demonstration: a simulated scan with live reconstruction, compared with the truth."""

COMMANDS = {
    "demo": ("Run a simulated scan with live reconstruction; writes a volume and a report.", True),
}
