"""Read noise: noise of the readout, as the camera's mode has it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.domain import Domain
from simulators.effects.shot import Image, Shot, draws
from simulators.sensor import READ_NOISE


@dataclass(frozen=True)
class ReadNoise:
    """Gaussian; pixels summed by binning are read one by one, so that their noise adds up."""

    name: ClassVar[str] = "read_noise"
    domain: ClassVar[Domain] = Domain.ELECTRONS
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        image += draws(self.name, shot).normal(0.0, READ_NOISE[shot.readout] * shot.binning, image.shape)
        return image
