"""Ghost: a fog-like change of the light crosses the frame from right to left in a few views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from simulators.effects.anomaly import VISIBLE, Label
from simulators.effects.chain import Anomaly, ImageEffect
from simulators.frame.mapping import Positive, Whole
from simulators.frame.shot import Image, Shot


@dataclass(frozen=True)
class Ghost(ImageEffect, Anomaly):
    """A smooth change of the light by a cos², as high as the frame. Flats do not have it.

    An early data set of a battery has it: "fog" that crosses the frame in a few views, with intensities that no other
    view has. Its cause is unknown. It may brighten (light scattered into the detector) or darken.

    Attributes:
        view: the first view that shows it, at the right edge.
        width: mm, full width at half height; it ends `width` from its middle.
        speed: mm to the left from one view to the next.
        gain: relative change of the light in its middle; negative for a dark ghost.
    """

    view: Whole
    width: Positive
    speed: Positive
    gain: Annotated[float, Field(ge=-1)] = 0.3

    def __post_init__(self) -> None:
        if self.gain == 0:
            raise ValueError("gain must be other than 0, which shows nothing")

    def apply(self, image: Image, shot: Shot) -> Image:
        first, change = self._change(shot)
        image[:, first : first + change.size] *= 1 + change
        return image

    def labels(self, shot: Shot) -> Sequence[Label]:
        first, change = self._change(shot)
        visible = np.flatnonzero(np.abs(change) >= VISIBLE)
        if not shot.beam or not visible.size:
            return []
        return [Label(self.name, (0, shot.detector.shape[0], first + int(visible[0]), first + int(visible[-1]) + 1))]

    def _change(self, shot: Shot) -> tuple[int, NDArray[np.float64]]:
        """The first column that it covers, and the relative change of the light from there to the right."""
        cols, pitch = shot.detector.shape[1], shot.detector.pitch
        if not shot.sample or shot.view < self.view:
            return 0, np.zeros(0)
        # The middle, in columns: half a step after the hump's left end has touched the frame's right edge.
        middle = cols - 0.5 + (self.width - self.speed * (shot.view - self.view + 0.5)) / pitch
        reach = self.width / pitch
        first = max(0, math.ceil(middle - reach))
        away = (np.arange(first, min(cols, math.floor(middle + reach) + 1)) - middle) / reach
        return first, self.gain * np.cos(0.5 * np.pi * away) ** 2
