"""Checks of this computer: its devices, disk and memory."""

COMMANDS = {
    "doctor": ("Check this computer: camera link, ports, disk, memory. Nothing moves.", False),
}
