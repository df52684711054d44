"""Materials: the volume of each material, fitted to scans at several energies."""

COMMANDS = {
    "materials": ("Fit the volume of each material to scans at several energies.", True),
}
