"""Solids of materials: how these attenuate, and what a beam of many energies sees of them."""

SOLID_KEYS = dict.fromkeys(("materials", "material", "instead_of"), f"{__name__}.parts")
"""Keys of a phantom of solids, or of a solid, that a module reads."""
