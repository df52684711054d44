"""Light: beams, the energies that they have, and the materials that tell these apart."""
