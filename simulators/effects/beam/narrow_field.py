"""Narrow field: the beam is narrower than the sample, whose sides get no light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulators.effects.anomaly import VISIBLE, Label, lit_share
from simulators.effects.chain import Anomaly, ImageEffect
from simulators.frame.mapping import NotNegative, Positive
from simulators.frame.shot import Image, Shot


@dataclass(frozen=True)
class NarrowField(ImageEffect, Anomaly):
    """An aperture before the sample lets a rectangle of light through, its edges soft by the penumbra of the source.

    Flats are equally narrow. Pixels without full light get a label for each side: left, right, above and below.

    Attributes:
        width: mm of the rectangle across the beam, between the places with half of the light.
        height: mm, vertically; None: the whole frame.
        centre: mm of its middle, (across, down the rows) from the projected rotation axis and z = 0.
        penumbra: mm over which the light rises from none to all.
    """

    width: Positive
    height: Positive | None = None
    centre: tuple[float, float] = (0.0, 0.0)
    penumbra: NotNegative = 0.0

    def apply(self, image: Image, shot: Shot) -> Image:
        down, across = self._light(shot)
        first, last = _lit_fully(across)
        image[:, :first] *= across[:first]
        image[:, last:] *= across[last:]
        first, last = _lit_fully(down)
        image[:first] *= down[:first, None]
        image[last:] *= down[last:, None]
        return image

    def labels(self, shot: Shot) -> Sequence[Label]:
        rows, cols = shot.detector.shape
        (top, below), (left, right) = (_lit_fully(light, VISIBLE) for light in self._light(shot))
        strips = [(0, rows, 0, left), (0, rows, right, cols), (0, top, 0, cols), (below, rows, 0, cols)]
        return [
            Label(self.name, strip, which)
            for which, strip in enumerate(strips)
            if shot.beam and strip[0] < strip[1] and strip[2] < strip[3]
        ]

    def _light(self, shot: Shot) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Shares of the light in each row and in each column; a pixel has their product."""
        detector = shot.detector
        across = self._between(detector.u() - self.centre[0], self.width)
        if self.height is None:
            return np.ones(detector.shape[0]), across
        return self._between(detector.v() - self.centre[1], self.height), across

    def _between(self, place: NDArray[np.float64], width: float) -> NDArray[np.float64]:
        # The part of the source that neither edge covers. The edges cover it from opposite ends.
        one, other = (lit_share(edge, self.penumbra) for edge in (width / 2 - place, width / 2 + place))
        return np.maximum(one + other - 1, 0.0)


def _lit_fully(light: NDArray[np.float64], less: float = 0.0) -> tuple[int, int]:
    """First pixel with at least 1 - `less` of the light and the one after the last; it falls off to both sides."""
    full = np.flatnonzero(light >= 1 - less)
    return (int(full[0]), int(full[-1]) + 1) if full.size else (light.size, light.size)
