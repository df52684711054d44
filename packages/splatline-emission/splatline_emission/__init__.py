"""Samples that emit (PET): simulates counts along lines of response, and finds the activity with the highest Poisson
likelihood."""

from splatline_emission.counts import Emission, read_counts, weighted_lines, write_counts
from splatline_emission.likelihood import attenuation_factors, mlem, passes_by_halves

__all__ = [
    "Emission",
    "attenuation_factors",
    "mlem",
    "passes_by_halves",
    "read_counts",
    "weighted_lines",
    "write_counts",
]
