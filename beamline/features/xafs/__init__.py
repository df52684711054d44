"""X-ray absorption fine structure: absorption edges of materials, and maps of charge from scans over energies."""

COMMANDS = {
    "xafs": ("Find a material's absorption edge and the energy of its highest contrast.", True),
}
