"""Read noise: noise of the readout, as the camera's mode has it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.domain import Domain
from simulators.effects.shot import Image, Shot, draws
from simulators.sensor import READ_NOISE


@dataclass(frozen=True)
class ReadNoise:
    """Gaussian; pixels summed by binning are read one by one, so that their noise adds up.

    `rms`: electrons of a sensor pixel, in place of the readout's.
    """

    rms: float | None = None

    name: ClassVar[str] = "read_noise"
    domain: ClassVar[Domain] = Domain.ELECTRONS
    final: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.rms is not None and not self.rms >= 0:
            raise ValueError(f"rms must be >= 0 electrons, got {self.rms}")

    def apply(self, image: Image, shot: Shot) -> Image:
        rms = READ_NOISE[shot.readout] if self.rms is None else self.rms
        image += draws(self.name, shot).normal(0.0, rms * shot.binning, image.shape)
        return image
