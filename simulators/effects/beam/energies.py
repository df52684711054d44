"""A beam of several energies: harmonics of the monochromator, and beam hardening."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import NotNegative, Positive, Share
from simulators.frame.shot import Image, Shot

PHOTOELECTRIC = 3.0**-3  # Attenuation at three times the energy, divided by the attenuation at the energy itself


@dataclass(frozen=True)
class Harmonics(ImageEffect):
    """exp(-d') = (1 - share) exp(-d) + share exp(-ratio d), for a sample that is defined by its attenuation.

    A crystal that reflects E from its planes (111) reflects 3E from (333). Photoelectric absorption falls as E^-3
    between edges (Als-Nielsen & McMorrow 2011, Elements of Modern X-ray Physics, ch. 1.3), so the ratio is 1/27. For a
    sample of materials, give the beam its harmonics instead: then each material has its true attenuation at both
    energies.

    Attributes:
        share: share of the detected photons of the open beam, 0 ... 1. ratio: ratio of the two attenuations, 0 ... 1.
    """

    share: Share
    ratio: Share = PHOTOELECTRIC

    def apply(self, image: Image, shot: Shot) -> Image:
        if self.share == 0:
            return image
        # The harmonic's exponential is factored out of the sum, so that large depths do not underflow.
        intensity = np.exp((self.ratio - 1) * image)
        intensity *= 1 - self.share
        intensity += self.share
        image *= self.ratio
        image -= np.log(intensity, out=intensity)
        return image


@dataclass(frozen=True)
class BeamHardening(ImageEffect):
    """exp(-d') = sum of w_k exp(-r_k d), with sum w_k = 1 and sum w_k r_k = 1, for a sample that is defined by its
    attenuation.

    The sample's attenuation is the mean over the spectrum, so that d' = d for a thin sample and d' < d for a thick one.
    The cost is one exponential of the image for each energy. For a sample of materials give the beam a spectrum
    instead: then each material has its true attenuation at each energy.

    Attributes:
        weights: shares of the detected photons of the open beam; only their proportions count.
        energies: keV; the attenuation is proportional to E^-3, like photoelectric absorption between edges (Als-Nielsen
            & McMorrow 2011, Elements of Modern X-ray Physics, ch. 1.3).
        ratios: the attenuations at the energies, in any unit; they replace the energies.
    """

    weights: tuple[NotNegative, ...]
    energies: tuple[Positive, ...] | None = None
    ratios: tuple[Positive, ...] | None = None

    def __post_init__(self) -> None:
        per_energy = self.energies if self.ratios is None else self.ratios
        if per_energy is None or (self.energies is not None and self.ratios is not None):
            raise ValueError(f"give either energies in keV or ratios of attenuations, got {self}")
        if len(per_energy) != len(self.weights) or not self.weights:
            raise ValueError(f"there must be one weight for each energy or ratio, and at least one, got {self}")
        if not sum(self.weights) > 0:
            raise ValueError(f"one of the weights must be positive, got {self.weights}")

    def terms(self) -> tuple[tuple[float, float], ...]:
        """(w_k, r_k) of the energies that have photons, the most penetrating first."""
        ratios = self.ratios if self.energies is None else tuple(energy**-3 for energy in self.energies)
        assert ratios is not None
        total = sum(self.weights)
        mean = sum(w * r for w, r in zip(self.weights, ratios, strict=True)) / total
        terms = ((r / mean, w / total) for w, r in zip(self.weights, ratios, strict=True) if w > 0)
        return tuple((w, r) for r, w in sorted(terms))

    def apply(self, image: Image, shot: Shot) -> Image:
        # The most penetrating energy's exponential is factored out of the sum, so that large depths do not underflow.
        (weight, least), *others = self.terms()
        intensity = np.full_like(image, weight)
        term = np.empty_like(image)
        for w, ratio in others:
            np.exp(np.multiply(image, least - ratio, out=term), out=term)
            term *= w
            intensity += term
        image *= least
        image -= np.log(intensity, out=intensity)
        return image
