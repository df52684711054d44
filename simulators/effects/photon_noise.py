"""Photon noise: photons arrive at random."""

from __future__ import annotations

from dataclasses import dataclass

from simulators.effects.chain import ImageEffect
from simulators.frame.shot import Image, Shot, frame_rng
from simulators.pixels.noise import poisson


@dataclass(frozen=True)
class PhotonNoise(ImageEffect):
    """Poisson around the expectation; photons are whole numbers afterwards.

    Detected photons and pixels are independent. Behind a scintillator this holds if few of an X-ray's photons reach
    the same pixel. If g of them reach it, the variance is 1 + g times larger and correlated by the blur (Cunningham,
    Westmore & Fenster 1994, Med. Phys. 21:417). That is not simulated: photons_per_s divided by 1 + g gives the same
    signal-to-noise ratio.
    """

    def apply(self, image: Image, shot: Shot) -> Image:
        return poisson(image, frame_rng(self.name, shot))
