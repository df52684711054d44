"""Numbers of a microstructure: fractions, sizes, surface, contacts, cracks, connected share and tortuosity."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage

from recon.base.greys import html, middle_slices
from splatline_structure.materials import F32, F64, Labels, Spacing, central, labelled
from splatline_structure.particles import NECK, Numbers, Particles, cleaned, measured, parted, surfaces
from splatline_structure.transport import connecting, tortuosity


@dataclass(frozen=True)
class Rules:
    """Rules for the measurement of numbers. Voxels that are not cubes count as cubes of their shortest edge.

    Attributes:
        particles: number of the material whose particles are measured, from 1, the least dense.
        through: number of the material whose connected share and tortuosity are measured.
        radius: radius in voxels of the ball that opens and closes particles: cracks up to twice as wide are closed.
        smallest: smallest particle, in voxels.
        neck: touching parts are one particle if the neck has at least this fraction of the narrower part's width.
        side: side of the central cube in which the tortuosity is computed, in voxels; 0: no tortuosity.
    """

    particles: int
    through: int
    radius: int = 1
    smallest: int = 27
    neck: float = NECK
    side: int = 96

    @property
    def of_coarse_voxels(self) -> Rules:
        """The same rules for voxels that are twice as wide."""
        return replace(self, smallest=max(self.smallest // 8, 1), side=(self.side + 1) // 2)


@dataclass(frozen=True, eq=False)
class Structure:
    """The results of the measurement of a volume.

    Attributes:
        labels: number of each voxel's material [z, y, x], from 0.
        numbered: number of each voxel's particle, 0: none.
        particles: the particles, lengths in µm.
        numbers: the numbers by name. NaN: there is nothing to measure. Infinity: nothing connects the two faces.
        along_z: fraction of the particles' material in each slice.
        radial: fraction of the particles' material in rings around the middle, and the radii of the rings in µm.
    """

    labels: Labels
    numbered: Numbers
    particles: Particles
    numbers: dict[str, float]
    along_z: F64
    radial: tuple[F64, F64]

    def _repr_html_(self) -> str:
        """HTML for a notebook: the particles in the middle slices, and the numbers."""
        pixels, _ = middle_slices(np.where(self.numbered > 0, 1 + self.numbered % 7, 0).astype(np.float32))
        texts = {name: f"{number:.4g} {unit_of(name)}" for name, number in self.numbers.items()}
        return html(f"Structure, particles: {len(self.particles.cut)}", pixels, texts)


def unit_of(name: str) -> str:
    """The unit of a number; empty for fractions, counts and factors."""
    return "1/µm" if name.startswith("surface") else "µm" if name.startswith("size") else ""


def structure_of(volume: F32, thresholds: F64, spacing: Spacing, rules: Rules) -> Structure:
    """Labels, particles and numbers of a volume.

    Args:
        volume: [z, y, x], finite.
        thresholds: thresholds between neighbouring materials, rising.
        spacing: edges of a voxel (z, y, x), µm.
    """
    labels = labelled(volume, thresholds)
    mask = labels == rules.particles - 1
    numbered = parted(cleaned(mask, rules.radius, rules.smallest, spacing), rules.neck, spacing)
    particles = measured(numbered, spacing)
    whole, inside = ~particles.cut, numbered > 0
    numbers = shares_of(labels, len(thresholds) + 1, spacing, rules)
    numbers |= {f"size_{share}": particles.quantile(share / 100) for share in (10, 50, 90)}
    numbers["sphericity"] = _or_nan(np.median, particles.sphericity[whole])
    numbers["contacts"] = _or_nan(np.mean, np.array([len(each) for each in particles.neighbours])[whole])
    numbers["cracks"] = _or_nan(np.mean, ~mask[inside])
    through = labels == rules.through - 1
    for axis, name in enumerate("zyx"):
        share = int(connecting(through, axis).sum()) / max(int(through.sum()), 1)
        numbers[f"connected_{name}"] = share if through.any() else math.nan
        if rules.side:
            numbers[f"tortuosity_{name}"] = tortuosity(central(through, rules.side, spacing), axis, spacing)
    return Structure(labels, numbered, particles, numbers, mask.mean(axis=(1, 2)), _radial(mask, spacing))


def shares_of(labels: Labels, count: int, spacing: Spacing, rules: Rules) -> dict[str, float]:
    """Fractions of `count` materials, and the surface of the particles' material: numbers that can be summed over
    slabs."""
    shares, mask = np.bincount(labels.ravel(), minlength=count) / labels.size, labels == rules.particles - 1
    surface = float(surfaces(mask.astype(np.uint8), spacing, goes_on=True)[-1]) / (mask.size * math.prod(spacing))
    return {**{f"fraction_{k}": float(share) for k, share in enumerate(shares, 1)}, "surface": surface}


def coarse(volume: F32) -> F32:
    """The volume with voxels twice as wide: means of eight voxels; a last odd voxel is left out."""
    nz, ny, nx = (n // 2 for n in volume.shape)
    eight = volume[: 2 * nz, : 2 * ny, : 2 * nx].reshape(nz, 2, ny, 2, nx, 2)
    return np.asarray(eight.mean(axis=(1, 3, 5), dtype=np.float32))


def _radial(mask: np.ndarray, spacing: Spacing) -> tuple[F64, F64]:
    _, ny, nx = mask.shape
    y, x = ((np.arange(n) - (n - 1) / 2) * edge for n, edge in zip((ny, nx), spacing[1:], strict=True))
    ring = (np.hypot(y[:, None], x) / (2 * spacing[2])).astype(int)  # so that it is two voxels wide
    share = ndimage.mean(mask.mean(axis=0), ring, np.arange(ring.max() + 1))
    return share, (np.arange(ring.max() + 1) + 0.5) * 2 * spacing[2]


def _or_nan(statistic: Callable[[np.ndarray], Any], values: np.ndarray) -> float:
    return float(statistic(values)) if values.size else math.nan
