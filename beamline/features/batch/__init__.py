"""Batches: many scans reconstructed by one recipe, with a table of what became of each."""

COMMANDS = {
    "batch": ("Reconstruct many scans by one recipe; a table says what became of each.", True),
}

COUNTED = {"batch": "scans"}
