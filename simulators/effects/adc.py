"""ADC: a converter of fewer bits, or a nonlinear one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from drivers.orca_quest import BITS
from simulators.effects.chain import ImageEffect
from simulators.frame.shot import CannotExposeError, Image, Shot


@dataclass(frozen=True)
class Adc(ImageEffect):
    """Counts in steps of 2^(16 - bits), from 0 to the last step. The codes are the upper bits of 16, so that conversion
    factor and offset hold at every depth. Without this effect the converter is linear and has 16 bits. The photon
    number readout needs such a converter, since fewer bits have steps wider than an electron.

    Attributes:
        bits: of a code.
        nonlinearity: integral: the largest departure of the response from the straight line through its ends, as a
            share of the range. F is the full range. The response bows, y = x + 4 nonlinearity x (1 - x / F).
    """

    bits: Literal[8, 12, 16] = 16
    nonlinearity: Annotated[float, Field(ge=-0.25, le=0.25)] = 0.0

    def apply(self, image: Image, shot: Shot) -> Image:
        """Raises CannotExposeError in the photon number readout, unless the converter is linear and has 16 bits."""
        if shot.readout == "photon_number" and (self.bits, self.nonlinearity) != (BITS, 0):
            raise CannotExposeError(
                f"adc: photon numbers need a linear converter of {BITS} bits, got {self.bits} bits and nonlinearity "
                f"{self.nonlinearity:g}; leave adc out, or choose the readout standard or ultra_quiet"
            )
        step, codes = 2.0 ** (BITS - self.bits), 2**self.bits - 1
        if self.nonlinearity:
            np.clip(image, 0, step * codes, out=image)
            image *= 1 + 4 * self.nonlinearity * (1 - image / (step * codes))
        image /= step
        np.clip(np.rint(image, out=image), 0, codes, out=image)
        image *= step
        return image
