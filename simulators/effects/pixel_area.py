"""Pixel area: a pixel counts the light on its whole area, instead of one ray through its middle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from simulators.effects.chain import AreaEffect


@dataclass(frozen=True)
class PixelArea(AreaEffect):
    """Mean of the transmission over rays x rays points of a pixel, evenly spread (midpoint rule).

    Without it edges are as sharp as a single ray, and jump from pixel to pixel. No volume of voxels explains such
    views, and iterative methods bend theirs (docs/studies.md).

    Attributes:
        rays: a side of the pixel, 2 ... 8; each of the rays² costs the line integrals of a frame.
    """

    rays: Annotated[int, Field(ge=2, le=8)] = 2

    @property
    def offsets(self) -> tuple[tuple[float, float], ...]:
        steps = [(k + 0.5) / self.rays - 0.5 for k in range(self.rays)]
        return tuple((row, col) for row in steps for col in steps)
