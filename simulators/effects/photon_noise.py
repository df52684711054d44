"""Photon noise: photons arrive at random."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.domain import Domain
from simulators.effects.shot import Image, Shot, draws


@dataclass(frozen=True)
class PhotonNoise:
    """Poisson around the expectation; the photons are whole numbers from here on."""

    name: ClassVar[str] = "photon_noise"
    domain: ClassVar[Domain] = Domain.PHOTONS
    final: ClassVar[bool] = True

    def apply(self, image: Image, shot: Shot) -> Image:
        return draws(self.name, shot).poisson(image).astype(np.float64)
