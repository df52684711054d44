"""Particles: cleans a mask, separates touching particles, and measures the size and place of each."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import regionprops_table
from skimage.morphology import ball, local_maxima, reconstruction
from skimage.segmentation import watershed

from recon.base.arrays import F32, Mask
from recon.base.choices import NECK

Labels = NDArray[np.int32]

_MARGIN = 3  # voxels around a particle that are looked at for its boundary
_TOGETHER, _PLACED = 1.2, 0.07  # voxels, see `volume_deviation`

_FACES = ndimage.generate_binary_structure(3, 1)  # neighbours of a voxel, with itself

_GRID = 0.5
"""Error of a distance on the grid, in voxels. Without it 41 of 360 turned ellipsoids, plates, bars, octahedra
are split in error, with it 1. With it 38 of 40 pairs of touching balls are separated, without it 40."""


@dataclass(frozen=True, eq=False)
class Particles:
    """Sizes and positions, one entry for each particle.

    Attributes:
        label: int32 [particle], in the labelled volume.
        volume: float64, of a voxel's unit of length cubed.
        centroid: float64 [particle, 3], (z, y, x).
        cut: bool, it touches a face of the volume, so that its true size may be larger.
    """

    label: Labels
    volume: NDArray[np.float64]
    centroid: NDArray[np.float64]
    cut: Mask

    @property
    def diameter(self) -> NDArray[np.float64]:
        """Diameter of the ball of the same volume, (6 V / π)^(1/3)."""
        return np.cbrt(6 * self.volume / np.pi)

    def statistics(self) -> dict[str, float]:
        """Numbers of particles and of cut ones; mean and 10th, 50th and 90th percentile of the other diameters."""
        whole = self.diameter[~self.cut]
        statistics = {"particles": float(self.label.size), "cut": float(self.cut.sum())}
        if whole.size:
            d10, d50, d90 = np.percentile(whole, [10, 50, 90])
            statistics |= {
                "mean_diameter": float(whole.mean()),
                "d10": float(d10),
                "d50": float(d50),
                "d90": float(d90),
            }
        return statistics


def bodies_outside(mask: Mask, box: tuple[slice, slice, slice]) -> int:
    """Connected bodies that no voxel of the box belongs to, without those that surround it in y and x, as a wall does.

    Args:
        mask: [z, y, x].
        box: part of the volume.
    """
    parts, n = ndimage.label(mask)
    inside = set(np.unique(parts[box]).tolist())
    _, y, x = box
    return sum(
        number not in inside
        and not (rows.start < y.start and rows.stop > y.stop and cols.start < x.start and cols.stop > x.stop)
        for number, (_, rows, cols) in enumerate(ndimage.find_objects(parts, n), 1)
    )


def cleaned(mask: Mask, radius: int = 1, smallest: int = 8) -> Mask:
    """The mask opened and closed, with holes filled, and parts of fewer than `smallest` voxels removed.

    The volume is continued beyond its faces, so that a particle there loses nothing.

    Args:
        mask: [z, y, x].
        radius: of opening and closing by a ball, voxels; 0: neither.
        smallest: voxels.

    Raises:
        ValueError: for a negative number.
    """
    if radius < 0 or smallest < 0:
        raise ValueError(f"radius and smallest must be 0 or more voxels, got {radius} and {smallest}")
    out = mask
    if radius:
        out = np.pad(out, 2 * radius, mode="edge")
        out = ndimage.binary_closing(ndimage.binary_opening(out, ball(radius)), ball(radius))
        out = out[(slice(2 * radius, -2 * radius),) * 3]
    out = ndimage.binary_fill_holes(out)
    parts, n = ndimage.label(out)
    kept = np.bincount(parts.ravel(), minlength=n + 1) >= smallest
    kept[0] = False
    return np.asarray(kept[parts])


def parted(mask: Mask, neck: float = NECK) -> Labels:
    """Labels [z, y, x] of the particles, 0 elsewhere: connected parts, separated at narrow necks.

    Watershed of the distance to the outside from its maxima (Beucher & Lantuéjoul 1979). Two maxima are one particle if
    the distance on the neck between them is at least `neck` times the smaller one: a maximum counts if its dynamics in
    log(distance) are larger than -log(neck) (Grimaud 1992).

    Args:
        neck: 0: connected parts as they are; 1 or more: every maximum is a particle.
    """
    connected, _ = ndimage.label(mask)
    if neck <= 0:
        return connected.astype(np.int32)
    labels, last = np.zeros(mask.shape, np.int32), 0
    for number, box in enumerate(ndimage.find_objects(connected), 1):
        inside = np.pad(connected[box] == number, 1)
        distance = ndimage.distance_transform_edt(inside).astype(np.float32)
        tops = distance
        if neck < 1:  # with this offset, heights differ by log(neck) where distances are `neck` times, less _GRID
            height = np.log(distance + np.float32(_GRID / (1 - neck)))
            tops = reconstruction(height + np.float32(math.log(neck)), height, footprint=_FACES)
        maxima, _ = ndimage.label(local_maxima(tops, connectivity=1) & inside)
        basins = watershed(-ndimage.gaussian_filter(distance, 0.7), maxima, 3, mask=inside)[1:-1, 1:-1, 1:-1]
        labels[box] = np.where(basins > 0, basins + last, labels[box])
        last += int(basins.max())
    return labels


def measured(
    labels: Labels, spacing: tuple[float, float, float] = (1, 1, 1), origin: tuple[float, float, float] = (0, 0, 0)
) -> Particles:
    """Sizes and positions of the particles in a labelled volume.

    Args:
        labels: int [z, y, x], 0 outside.
        spacing: edges of a voxel (z, y, x).
        origin: centre of the first voxel (z, y, x).
    """
    found = regionprops_table(labels, properties=("label", "area", "centroid", "bbox"), spacing=spacing)
    ends = np.array([[found[f"bbox-{axis}"], found[f"bbox-{axis + 3}"]] for axis in range(3)])
    cut = (ends[:, 0] == 0) | (ends[:, 1] == np.array(labels.shape)[:, None])
    centroid = np.stack([found[f"centroid-{axis}"] + origin[axis] for axis in range(3)], axis=1)
    return Particles(found["label"].astype(np.int32), found["area"].astype(np.float64), centroid, cut.any(axis=0))


def volume_deviation(labels: Labels, grey: F32, deviation: F32, threshold: float) -> NDArray[np.float64]:
    """The standard deviation of each particle's volume, in voxels, in the order of `measured`.

    An error e of the grey value moves the boundary by e / |gradient|. Two parts are added in squares. The errors by the
    `deviation` of the grey values at a distance d have the correlation exp(-d² / (2 · 1.2²)), d in voxels. And the
    whole surface may lie off by 0.07 voxels, the same everywhere: the threshold, the blur and the opening place it so.
    Both numbers are from balls of radius 2.5 to 7 voxels in six simulated volumes, by FBP and FISTA-TV. Of the true
    volumes of others, 58 to 84 % are within one deviation (docs/error_bars.md). Particles of a few voxels lose more to
    the opening.

    Args:
        labels, grey, deviation: [z, y, x]; the particles are `grey` above `threshold`.
    """
    deviations = []
    for number, box in enumerate(ndimage.find_objects(labels), 1):
        if box is None:
            continue
        box = tuple(slice(max(part.start - _MARGIN, 0), part.stop + _MARGIN) for part in box)
        own, others, values = labels[box] == number, labels[box] > 0, grey[box].astype(np.float64)
        near = ndimage.binary_dilation(own, iterations=2) & (own | ~others)
        steps = [np.gradient(values, axis=axis) for axis, n in enumerate(values.shape) if n > 1]
        slope = np.maximum(np.sqrt(sum(np.square(step) for step in steps)), 1e-9)
        filled = [np.clip((values - threshold + sign * deviation[box]) / slope + 0.5, 0, 1) for sign in (1, -1)]
        moved = (filled[0] - filled[1]) / 2 * near
        together = (math.sqrt(2 * math.pi) * _TOGETHER) ** 3
        noise = together * float((moved * ndimage.gaussian_filter(moved, _TOGETHER)).sum())
        faces = sum(np.count_nonzero(np.diff(own, axis=axis)) for axis in range(3))
        deviations.append(
            math.sqrt(noise + (_PLACED * 2 / 3 * faces) ** 2)
        )  # a ball has 3/2 faces per unit of its surface
    return np.array(deviations)
