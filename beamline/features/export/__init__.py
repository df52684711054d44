"""Volumes in other formats, and films of volumes and views."""

COMMANDS = {
    "export": ("Copy a volume to another format, with grey values if wanted, or make a film of it.", True),
}
