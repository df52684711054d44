"""Evidence: statistics of darks, flats and some projections, of a running scan or of a file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.digest import FrameDigest, subsampled
from drivers.base.frame import FrameKind
from recon.base.arrays import F32, Mask
from recon.base.noise import deviation_between_frames, deviation_between_neighbours

LEAST_NOISE = 0.5  # counts: differences below this may be hidden by rounding
BRIGHT = 90.0  # percentile of a frame's blocks that represents its intensity
DRIFT = 0.02  # fraction of the intensity by which a beam may drift within a scan (as in the check `beam`)
UNLIT = 0.05  # share of the bright part's intensity: a place with less counts as dark
LEAST_BLOCKS = 200  # number of differences of neighbouring blocks from which the noise is known to 15 %
ZINGER = 12.0  # factor on the median change; a larger change is not noise


@dataclass(frozen=True, eq=False)
class FrameStatistics:
    """Statistics of a dark, a flat or a projection.

    Attributes:
        row: row of the frame in the file.
        exposure: exposure time in s, NaN if unknown.
        saturated: fraction of the pixels at or above the saturation value.
        blocks: float32, means of blocks of pixels; if the preview is large, only a part of it.
        block: side of a block in pixels.
        rounding: largest noise that rounding to the type of the pixels may hide; 0 for real numbers.
        invalid: fraction of the pixels that are not finite.
        cells: float32, means of larger blocks that cover the frame; None: not needed.
    """

    row: int
    kind: FrameKind
    exposure: float
    saturated: float
    blocks: F32
    block: int
    rounding: float = LEAST_NOISE
    invalid: float = 0.0
    cells: F32 | None = None

    @classmethod
    def of(cls, row: int, kind: FrameKind, exposure: float, digest: FrameDigest, block: int) -> FrameStatistics:
        """The statistics of a frame of a running scan, taken from its digest."""
        return cls(row, kind, exposure, digest.saturated_fraction, np.array(subsampled(digest.preview)), block)

    @property
    def seconds(self) -> float:
        """The exposure in s, or 1 if it is not known."""
        return self.exposure if self.exposure > 0 else 1.0

    @property
    def rounded_exposure(self) -> float:
        """The exposure, rounded as cameras state it; 0 if it is not known."""
        return round(self.exposure, 6) if self.exposure > 0 else 0.0

    @property
    def pixels(self) -> int:
        """Approximate number of pixels, because blocks may extend beyond the edge of the frame."""
        return self.blocks.size * self.block**2

    @property
    def blank(self) -> bool:
        """True if no pixel has a valid value."""
        return bool(np.isnan(self.blocks).all())

    @property
    def constant(self) -> bool:
        """True if all blocks have the same value."""
        known = self.blocks[np.isfinite(self.blocks)]
        return not (known.size and np.ptp(known) > 0)

    @property
    def places(self) -> F32:
        """The cells; without cells, the blocks."""
        return self.blocks if self.cells is None else self.cells


Group = Sequence[FrameStatistics]


class BadFrames(NamedTuple):
    """A finding about frames of a group that cannot be used: the score, the violated limit, and a sentence with both
    and with advice. If no frames are named, the finding concerns the whole group.
    """

    frames: Group
    score: float
    limit: float
    sentence: str


def range_in_words(scores: Iterable[float]) -> str:
    """The smallest and the largest score in words."""
    low, high = f"{min(scores):.3g}", f"{max(scores):.3g}"
    return low if low == high else f"{low} to {high}"


@dataclass(frozen=True, eq=False)
class Evidence:
    """Groups of darks and groups of flats, in the order of the file, and some projections."""

    groups: tuple[tuple[FrameStatistics, ...], ...] = ()
    views: tuple[FrameStatistics, ...] = ()

    def of_kind(self, kind: FrameKind) -> list[Group]:
        """The groups of darks, or of flats."""
        return [group for group in self.groups if group[0].kind is kind]

    def frames(self, kind: FrameKind) -> list[FrameStatistics]:
        """All darks, or all flats."""
        return [frame for group in self.of_kind(kind) for frame in group]

    @cached_property
    def darkest(self) -> Group:
        """The group of darks with the lowest level; empty without darks."""
        return min(self.of_kind(FrameKind.DARK), key=level, default=())

    @cached_property
    def brightest(self) -> Group:
        """The group of flats with the highest intensity; empty without flats."""
        return max(self.of_kind(FrameKind.FLAT), key=self.intensity_of, default=())

    def intensity_of(self, group: Group) -> float:
        """Counts above the darks in the bright part of the frame; per second, if the exposure is known."""
        dark = level(self.darkest) if self.darkest else 0.0
        return float(np.median([(level([frame]) - dark) / frame.seconds for frame in group]))

    def with_frame(self, frame: FrameStatistics, begins: bool) -> Evidence:
        """The evidence with the next frame of the scan added. A dark or a flat may start a new group."""
        if frame.kind is FrameKind.PROJECTION:
            return replace(self, views=(*self.views, frame))
        begins = begins or not self.groups or self.groups[-1][0].kind is not frame.kind
        *before, last = (*self.groups, ()) if begins else self.groups
        return replace(self, groups=(*before, (*last, frame)))

    def without(self, rows: set[int]) -> Evidence:
        """The evidence without some frames, and without groups that become empty."""
        groups = (tuple(frame for frame in group if frame.row not in rows) for group in self.groups)
        views = tuple(view for view in self.views if view.row not in rows)
        return Evidence(tuple(group for group in groups if group), views)

    @cached_property
    def base(self) -> F32 | float:
        """Counts without beam: the mean of all darks; 0 if there are no darks."""
        darks = [frame.places for frame in self.frames(FrameKind.DARK)]
        return np.asarray(np.mean(darks, axis=0), np.float32) if darks else 0.0

    def intensity(self, frame: FrameStatistics) -> F32:
        """Counts of a frame above the darks, at each place."""
        return np.asarray(np.nan_to_num(frame.places - self.base), np.float32)

    @cached_property
    def lit_views(self) -> list[FrameStatistics]:
        """The projections that are brighter than with a closed shutter, and whose pixels do not all have the same
        value."""
        intensity = [float(np.percentile(self.intensity(view), BRIGHT)) for view in self.views]
        least = UNLIT * max(intensity, default=0.0)
        return [
            view for view, bright in zip(self.views, intensity, strict=True) if bright > least and not view.constant
        ]


def level(group: Group) -> float:
    """Counts in the bright part of a frame. (Only this part is used, because the beam may be narrower than the
    detector.)"""
    return float(np.median([np.nanpercentile(frame.blocks, BRIGHT) for frame in group]))


def offset(darks: Group | None) -> F32 | float:
    """Mean counts of the blocks without beam."""
    return np.asarray(np.mean([dark.blocks for dark in darks], axis=0)) if darks else 0.0


def pixel_noise(group: Group) -> float:
    """Standard deviation of a pixel between frames; for a single frame, between pixels."""
    return deviation_between_frames(np.stack([frame.blocks for frame in group])) * group[0].block


def place_noise(values: NDArray[np.floating]) -> float:
    """Noise of a place, from the differences to its neighbours in the row. Sample and beam change more slowly from
    place to place."""
    return deviation_between_neighbours(values, 2)


def lit_places(intensity: F32) -> Mask:
    """Mask of the places that get beam."""
    return intensity > UNLIT * max(float(np.percentile(intensity, BRIGHT)), 1e-30)


def photons(flats: Group, darks: Group) -> float | None:
    """Median number of photons in a pixel of the flats with beam: the squared intensity, divided by the variance that
    the beam adds.

    The method is photon transfer (Janesick 2007). The variance comes from changes, between frames, of the difference of
    neighbouring blocks, so that a flickering or moving beam does not count as noise. None if there are too few frames
    or blocks, or if the flats have no photon noise.
    """
    intensity = np.mean([flat.blocks for flat in flats], axis=0) - offset(darks)
    exposed = intensity > UNLIT * float(np.nanpercentile(intensity, BRIGHT))
    exposed_pairs = exposed[:, 1:] & exposed[:, :-1]
    if len(flats) < 2 or (len(flats) - 1) * exposed_pairs.sum() < LEAST_BLOCKS:
        return None
    levels = np.array([np.median((flat.blocks - offset(darks))[exposed]) for flat in flats])
    even = np.stack([flat.blocks for flat in flats]) * (levels.mean() / levels)[:, None, None].astype(np.float32)
    change = np.diff(np.diff(even, axis=0), axis=2)[:, exposed_pairs]
    squares = change.astype(np.float64) ** 2
    variance = float(squares[squares <= ZINGER**2 * np.median(squares)].mean()) / 4 * flats[0].block ** 2
    brought = variance - pixel_noise(darks) ** 2
    return float(np.median(intensity[exposed]) * intensity[exposed].mean()) / brought if brought > 0 else None


def full_scale(largest: float) -> float:
    """The saturation count of a detector, estimated from its largest count: the end of its 8, 10, 12, 14 or 16 bits."""
    return next((2.0**bits - 1 for bits in (8, 10, 12, 14, 16) if 2**bits > largest), np.inf)


def lights_in_turn(levels: NDArray[np.floating]) -> int:
    """Number of intensity levels between which consecutive frames [frame] alternate, 2 or 3; 0: they do not alternate.

    Frames alternate if the change between frames of the same level is at most a third of the difference between levels.
    In a drift, the change is larger.
    """
    for n in range(2, min(3, levels.size // 2) + 1):
        between = float(np.ptp([np.median(levels[first::n]) for first in range(n)]))
        if between > 3.0 * float(np.abs(levels[n:] - levels[:-n]).max()):
            return n
    return 0
