"""Volumes in other formats."""

COMMANDS = {
    "export": ("Copy a volume to another format, with grey values if wanted.", True),
}
