"""NAF, IntraTomo and SaxNerf: neural fields as methods, with the settings that their user chooses.

They differ in the network and in the rays of a step; `train` fits all of them. Published: 150 000 steps of a view with
50 views, at a rate of 0.001. Here: fewer at a higher rate, for a CPU. Three more departures: a hash grid
ends where its cubes are a voxel (published: 16 levels, most of them finer than a voxel of 256³). Steps take any ray
that has a weight (published: pixels above zero, `foreground`; what only rays through air meet is then undetermined).
The density begins at the mean of the box (published: at half of the highest, where a high rate ends at zero).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

from recon.base.declared_types import Bound, Count, Natural
from recon.features.neural.networks import Field, HashGrid, Waves
from recon.features.neural.train import FieldMethod

_COARSEST = 16  # cubes an edge of the first level


@dataclass(frozen=True)
class _HashField(FieldMethod):
    """Settings of a field on a hash grid.

    Attributes:
        levels: of the grid, from 16 cubes an edge, each with twice as many; None: until a cube is a voxel.
        log2_table: logarithm of the most entries of a level.
    """

    levels: Annotated[int, Bound(1, 16)] | None = None
    log2_table: Annotated[int, Bound(8, 24)] = 19

    def grid_of(self, across: int) -> HashGrid:
        to_voxels = 1 + max(0, math.ceil(math.log2(across / _COARSEST)))
        return HashGrid(min(to_voxels, 16) if self.levels is None else self.levels, self.log2_table)

    @property
    def limit(self) -> float | None:
        return None if self.allow_negative else self.highest


@dataclass(frozen=True)
class NAF(_HashField):
    """Neural attenuation field: a hash grid and a small perceptron (Zha et al. 2022, MICCAI)."""

    name: ClassVar[str] = "naf"
    label: ClassVar[str] = "NAF"

    def network(self, across: int) -> Field:
        return Field(self.grid_of(across), self.width, waves=False, attention=False, highest=self.limit)


@dataclass(frozen=True)
class SaxNerf(_HashField):
    """SAX-NeRF: as NAF, with attention along line segments, and windows of rays (Cai et al. 2024, CVPR).

    Attributes:
        window_count, window_side: squares of pixels of each step, beside `rays` outside of them.
    """

    name: ClassVar[str] = "sax-nerf"
    label: ClassVar[str] = "SAX-NeRF"

    window_count: Natural = 16
    window_side: Count = 8

    @property
    def windows(self) -> tuple[int, int]:
        return self.window_count, self.window_side

    def network(self, across: int) -> Field:
        return Field(self.grid_of(across), self.width, waves=False, attention=True, highest=self.limit)


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
    bands: Count = 6

    def network(self, across: int) -> Field:
        highest = None if self.allow_negative else self.highest
        return Field(Waves(self.bands), self.width, waves=True, attention=False, highest=highest)
