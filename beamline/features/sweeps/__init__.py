"""Sweeps: any option of a reconstruction over a range, as a sheet of the same slice, with a score."""

COMMANDS = {
    "sweep": ("Reconstruct one slice with each value of an option, as a sheet with scores.", True),
}
