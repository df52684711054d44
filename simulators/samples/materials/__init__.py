"""Solids of materials: their attenuation, and their effect in a beam of many energies."""

SOLID_KEYS = dict.fromkeys(("materials", "material", "instead_of"), f"{__name__}.parts")
"""Keys of a phantom of solids, or of a solid, that a module reads."""
