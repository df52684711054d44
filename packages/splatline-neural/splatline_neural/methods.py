"""NAF, IntraTomo and SaxNerf: neural fields as methods, with the settings that their user chooses.

They differ in the network and in the rays of a step; `train` fits all of them. Published: 150 000 steps of a view with
50 views, at a rate of 0.001. Here: fewer at a higher rate, for a CPU. Three more departures: a hash grid
ends where its cubes are a voxel (published: 16 levels, most of them finer than a voxel of 256³). Steps take any ray
that has a weight (published: pixels above zero; what only rays through air meet is then undetermined).
The density begins at the mean of the box (published: at half of the highest, where a high rate ends at zero).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from splatline_neural.networks import Field, HashGrid, Waves
from splatline_neural.train import FieldMethod

_COARSEST = 16  # cubes an edge of the first level


@dataclass(frozen=True)
class NAF(FieldMethod):
    """Neural attenuation field: a hash grid and a small perceptron (Zha et al. 2022, MICCAI).

    Attributes:
        levels: of the grid, 1 to 16 from 16 cubes an edge, each with twice as many; None: until a cube is a voxel.
        log2_table: logarithm of the most entries of a level, 8 to 24.
    """

    name: ClassVar[str] = "naf"
    label: ClassVar[str] = "NAF"
    attention: ClassVar[bool] = False

    levels: int | None = None
    log2_table: int = 19

    def network(self, across: int) -> Field:
        to_voxels = 1 + max(0, math.ceil(math.log2(across / _COARSEST)))
        grid = HashGrid(min(to_voxels, 16) if self.levels is None else self.levels, self.log2_table)
        return Field(grid, self.width, waves=False, attention=self.attention, highest=self.limit)


@dataclass(frozen=True)
class SaxNerf(NAF):
    """SAX-NeRF: as NAF, with attention along line segments, and windows of rays (Cai et al. 2024, CVPR).

    Attributes:
        window_count, window_side: squares of pixels of each step, beside `rays` outside of them.
    """

    name: ClassVar[str] = "sax-nerf"
    label: ClassVar[str] = "SAX-NeRF"
    attention: ClassVar[bool] = True

    window_count: int = 16
    window_side: int = 8

    @property
    def windows(self) -> tuple[int, int]:
        return self.window_count, self.window_side


@dataclass(frozen=True)
class IntraTomo(FieldMethod):
    """A field of Fourier features, the class of IntraTomo's sinogram prediction (Zang et al. 2021, ICCV).

    Its later refinement is left out. No code of the authors is public; width and bands are our own.

    Attributes:
        bands: octaves of the features, from one wave an edge of the box.
    """

    name: ClassVar[str] = "intratomo"
    label: ClassVar[str] = "IntraTomo-class field"

    rate: float = 3e-3
    width: int = 128
    bands: int = 6

    def network(self, across: int) -> Field:
        return Field(Waves(self.bands), self.width, waves=True, attention=False, highest=self.limit)
