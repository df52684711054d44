"""Neural fields: a volume as a network of the coordinates, fitted to line integrals along sampled rays."""

from splatline_neural.methods import NAF, IntraTomo, SaxNerf

__all__ = ["NAF", "IntraTomo", "SaxNerf"]
