"""Effects of the sensor: efficiency, noise, dark current, full well, offset and analogue-to-digital converter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.orca_quest import BITS, QE_NM, LightPath, quantum_efficiency
from recon.base.setting import setting
from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import NotNegative, Positive, Share, Whole
from simulators.frame.sensor import DARK_CURRENT, FULL_WELL, OFFSET, READ_NOISES
from simulators.frame.shot import CannotExposeError, Image, Shot, frame_rng
from simulators.pixels.noise import add_normal, poisson
from simulators.pixels.pattern import binned, normals


@dataclass(frozen=True)
class QuantumEfficiency(ImageEffect):
    """Scales the expectation before the photon noise. This is exact, because a thinned Poisson process is a Poisson
    process (Kingman 1993, ch. 5).

    A scene's beam.photons_per_s are then photons of the scintillator's light that arrive at the sensor; without this
    effect they are detected photons. LuAG:Ce emits at 535 nm, CsI:Tl at 550 nm (Crytur, scintillation materials).

    Attributes:
        value: 0 ... 1, or
        wavelength_nm: 300 ... 1000, for ORCA-Quest's curve, interpolated linearly, or
        path: the path from X-ray photons to electrons; photons_per_s then counts X-ray photons. The noise of X-ray
            photons is not simulated, only the noise of light, see `PhotonNoise`.
    """

    value: Share | None = None
    wavelength_nm: float | None = setting(None, ge=QE_NM[0], le=QE_NM[-1])
    path: LightPath | None = None

    def __post_init__(self) -> None:
        if sum(each is not None for each in (self.value, self.wavelength_nm, self.path)) != 1:
            raise ValueError(f"give one of value, wavelength_nm or path, got {self}")

    @property
    def efficiency(self) -> float:
        """Number of photoelectrons per photon."""
        if self.path is not None:
            return self.path.absorbed * self.path.electrons
        if self.wavelength_nm is not None:
            return quantum_efficiency(self.wavelength_nm)
        assert self.value is not None
        return self.value

    def apply(self, image: Image, shot: Shot) -> Image:
        image *= self.efficiency
        return image


@dataclass(frozen=True)
class PhotonNoise(ImageEffect):
    """Poisson noise around the expected photons, which are whole numbers afterwards.

    Detected photons and pixels are independent. Behind a scintillator this is true if few of the light photons of one
    X-ray photon reach the same pixel. If g of them reach it, the variance is 1 + g times larger and correlated by the
    blur (Cunningham, Westmore & Fenster 1994, Med. Phys. 21:417). This is not simulated: photons_per_s divided by 1 + g
    gives the same signal-to-noise ratio.
    """

    def apply(self, image: Image, shot: Shot) -> Image:
        return poisson(image, frame_rng(self.name, shot))


FEW = 1.0  # electrons per pixel; below this, placing single electrons is faster than drawing a number for every pixel


@dataclass(frozen=True)
class DarkCurrent(ImageEffect):
    """Electrons without light: Poisson around dark current times exposure.

    A few electrons are placed over the frame: their number is Poisson and each pixel is equally likely. This makes
    every pixel's number Poisson and independent of the others' (Kingman 1993, "Poisson Processes", sec. 5.1).

    Attributes:
        rate: dark current, electrons per second in each sensor pixel.
    """

    rate: NotNegative = DARK_CURRENT

    def apply(self, image: Image, shot: Shot) -> Image:
        rng = frame_rng(self.name, shot)
        mean = self.rate * shot.exposure * shot.binning**2
        if mean < FEW:
            falls = rng.integers(image.size, size=rng.poisson(mean * image.size))
            np.add.at(image.reshape(-1), falls, 1.0)
        else:
            image += poisson(np.full(image.shape, mean), rng)
        return image


@dataclass(frozen=True)
class Saturation(ImageEffect):
    """Charge x is clipped at the full well W; with a knee, charge above x0 = (1 - knee) W becomes
    x0 + (W - x0) (1 - exp(-(x - x0) / (W - x0))). This bends smoothly and stays below the full well.

    Name it after all effects that add charge and before the read noise. Binned pixels share their light evenly.

    Attributes:
        full_well: electrons of a sensor pixel.
        knee: share of the full well over which the response bends.
    """

    full_well: Positive = FULL_WELL
    knee: Share = 0.0

    def apply(self, image: Image, shot: Shot) -> Image:
        well = self.full_well * shot.binning**2
        bend = self.knee * well
        if bend > 0:
            above = image > well - bend
            image[above] = well - bend - bend * np.expm1(-(image[above] - (well - bend)) / bend)
        return np.minimum(image, well, out=image)


@dataclass(frozen=True)
class ReadNoise(ImageEffect):
    """Gaussian noise of the readout. The camera reads the sensor pixels of a binned pixel one by one, so their
    variances add up.

    Attributes:
        rms: noise of a sensor pixel in electrons; it replaces the value of the readout.
        spread: differences between pixels: standard deviation of ln(rms of a pixel); the median is rms.
        seed: seed of the pixels' noise.
    """

    rms: NotNegative | None = None
    spread: float = setting(0.0, ge=0, le=2)
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        rms = READ_NOISES[shot.model][shot.readout] if self.rms is None else self.rms
        add_normal(image, rms * self._spreads(shot), frame_rng(self.name, shot))
        return image

    def _spreads(self, shot: Shot) -> Image | float:
        """Noise of each frame pixel, divided by that of a typical sensor pixel."""
        if self.spread == 0:
            return shot.binning
        pixels = normals(self.name, self.seed, shot)
        pixels *= self.spread * (1 if shot.binning == 1 else 2)
        np.exp(pixels, out=pixels)
        return pixels if shot.binning == 1 else np.sqrt(binned(pixels, shot.binning))


@dataclass(frozen=True)
class Offset(ImageEffect):
    """Offset of the counts, the same for any binning (to check on a camera). The photon number readout has no offset.

    Attributes:
        spread: standard deviation between sensor pixels in counts (normal distribution), about 1 on an ORCA-Quest; the
            offsets of binned pixels add up. seed: seed of the offsets.
    """

    spread: NotNegative = 0.0
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        image += OFFSET[shot.readout]
        if self.spread > 0 and shot.readout != "photon_number":
            pattern = binned(normals(self.name, self.seed, shot), shot.binning)
            pattern *= self.spread
            image += pattern
        return image


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
    nonlinearity: float = setting(0.0, ge=-0.25, le=0.25)

    def apply(self, image: Image, shot: Shot) -> Image:
        """Raises CannotExposeError in the photon number readout, unless the converter is linear and has 16 bits."""
        if shot.readout == "photon_number" and (self.bits, self.nonlinearity) != (BITS, 0):
            raise CannotExposeError(
                f"adc: photon numbers need a linear converter of {BITS} bits, got {self.bits} bits and "
                f"nonlinearity {self.nonlinearity:g}; omit adc, or choose the readout standard or "
                "ultra_quiet"
            )
        step, codes = 2.0 ** (BITS - self.bits), 2**self.bits - 1
        if self.nonlinearity:
            np.clip(image, 0, step * codes, out=image)
            image *= 1 + 4 * self.nonlinearity * (1 - image / (step * codes))
        image /= step
        np.clip(np.rint(image, out=image), 0, codes, out=image)
        image *= step
        return image
