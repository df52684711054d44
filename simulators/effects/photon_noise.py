"""Photon noise: photons arrive at random."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.domain import Domain
from simulators.effects.shot import Image, Shot, draws
from simulators.noise import poisson


@dataclass(frozen=True)
class PhotonNoise:
    """Poisson around the expectation; the photons are whole numbers from here on."""

    name: ClassVar[str] = "photon_noise"
    domain: ClassVar[Domain] = Domain.PHOTONS
    final: ClassVar[bool] = True

    def apply(self, image: Image, shot: Shot) -> Image:
        return poisson(image, draws(self.name, shot))
