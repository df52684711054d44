"""Light: beams, their energies, and materials whose attenuation depends on them."""
