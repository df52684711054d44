"""Batches: many scans reconstructed with one recipe, and a table with the result of each."""

COMMANDS = {
    "batch": ("Reconstruct many scans with one recipe; a table lists the result of each.", True),
}

COUNTED = {"batch": "scans"}
