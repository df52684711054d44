"""X-ray absorption: edge, white line, and the energy of the highest contrast."""
