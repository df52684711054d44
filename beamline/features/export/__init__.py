"""Volumes in other formats."""

COMMANDS = {
    "export": ("Copy a volume to another format, for example 8-bit or 16-bit TIFF.", True),
}
