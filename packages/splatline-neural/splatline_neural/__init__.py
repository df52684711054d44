"""Neural fields: a network computes the density at a point, and is fitted to line integrals along sampled rays."""

from splatline_neural.methods import NAF, IntraTomo, SaxNerf

__all__ = ["NAF", "IntraTomo", "SaxNerf"]
