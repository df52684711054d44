"""References: darks and flats, the flat for a projection, dead pixels, and the air next to the sample."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.base.arrays import F32, F64, MEDIAN, Mask, median_deviation, without_mask
from recon.base.declared_types import check_settings
from recon.base.masks import Image
from recon.base.noise import deviation_between_neighbours
from recon.prep.dynamic_flats import DynamicFlats
from recon.prep.spots import without_spots
from recon.prep.unmeasured import with_rim

DarkImage = TypeVar("DarkImage", F32, F64)


@dataclass(frozen=True, eq=False)
class References:
    """Darks (images without beam) and flats (images with beam but without sample).

    If darks or flats are a stack of frames [frame, row, col] of any real type, the stack is replaced by the mean of its
    frames, without the zingers of single frames. The flat of a projection is computed from the flats in the same part
    of the scan (see `part_starts`). If the part of the scan contains no flats, the nearest group of flats is used.

    Attributes:
        dark: float32 [row, col], mean or median of the darks; or all darks as a stack.
        flats: (position, float32 [row, col]) of each group of flats, or (position, stack); the position is the number
            of the frame in the scan at which the group was taken.
        dynamic: components of the differences between flats, from which the flat of each projection is computed; None
            if the flat of a projection is interpolated between groups of flats.
        part_starts: the first frame of each part of the scan, ascending.
    """

    dark: Image
    flats: tuple[tuple[float, Image], ...]
    dynamic: DynamicFlats | None = None
    part_starts: tuple[int, ...] = (0,)

    def __post_init__(self) -> None:
        flat_values = np.ma.filled(self.flats[0][1], 0) if isinstance(self.flats, tuple) and self.flats else np.zeros(0)
        beam = float(np.nanpercentile(flat_values, _BRIGHT)) if np.size(flat_values) else 0.0
        object.__setattr__(self, "dark", _mean(self.dark, "darks", beam))
        check_settings(self)
        flats = tuple((position, _mean(flat, f"flats at {position:g}", beam)) for position, flat in self.flats)
        object.__setattr__(self, "flats", flats)

    def rows(self, rows: slice) -> References:
        """The darks and flats of some detector rows."""
        flats = tuple((position, flat[rows]) for position, flat in self.flats)
        dynamic = None if self.dynamic is None else self.dynamic.rows(rows)
        return replace(self, dark=self.dark[rows], flats=flats, dynamic=dynamic)


def _mean(frames: Image, what: str, beam: float) -> Image:
    """The mean of a stack; a single image is returned unchanged. Pixels that are masked in all frames are NaN."""
    if np.ndim(frames) != 3:
        return cast(Image, without_mask(frames))
    if not len(frames):
        raise ValueError(f"the stack of {what} is empty; give at least one frame [frame, row, col]")
    if not np.ma.is_masked(frames):
        frames = np.stack([frame for frame, _ in without_spots(without_mask(frames), beam)])
    return np.asarray(without_mask(np.mean(frames, axis=0, dtype=np.float64)), np.float32)


def check(references: References) -> None:
    """Raise ValueError if there are no flats, shapes disagree, or two groups of flats have the same position."""
    if not references.flats:
        raise ValueError("counts cannot be converted to line integrals without a flat; give at least one flat")
    shape = np.shape(references.dark)
    for position, flat in references.flats:
        if np.shape(flat) != shape or len(shape) != 2:
            raise ValueError(
                f"the dark has shape {shape}, the flat at position {position:g} has shape {np.shape(flat)}; both must "
                "have the same shape"
            )
    positions = sorted(p for p, _ in references.flats)
    if len(set(positions)) < len(positions) or not np.isfinite(positions).all():
        raise ValueError(
            f"each group of flats needs a different, finite position in the scan, got {positions}; average flats that "
            "belong together"
        )


def dark_at(exposure: float, darks: Sequence[tuple[float, DarkImage]]) -> DarkImage:
    """The dark for an exposure time in s. A dark is linear in the exposure time, so two darks determine all others.

    Args:
        darks: one or more pairs (exposure time in s, image [row, col]) with different exposure times.
    """
    by_distance = sorted(darks, key=lambda dark: abs(dark[0] - exposure))
    (first, first_image), *others = by_distance
    if not others or first == exposure:
        return first_image
    second, second_image = others[0]
    return first_image + (exposure - first) / (second - first) * (second_image - first_image)


def flat_at(position: float, groups: Sequence[tuple[float, Image]], part_starts: tuple[int, ...]) -> Image:
    """Flat minus dark at the position of a frame: interpolated between the two groups of its part around the frame;
    without two such groups, that of the nearest group."""
    part = bisect_right(part_starts, position)
    of_part = [group for group in groups if bisect_right(part_starts, group[0]) == part]
    groups = of_part or [min(groups, key=lambda group: abs(group[0] - position))]
    positions = [p for p, _ in groups]
    upper = int(np.searchsorted(positions, position))
    if upper == 0 or upper == len(groups):
        return groups[min(upper, len(groups) - 1)][1]
    weight = np.float32((position - positions[upper - 1]) / (positions[upper] - positions[upper - 1]))
    return groups[upper - 1][1] * (1 - weight) + groups[upper][1] * weight


# a pixel is in a shadow if no projection has this share of the intensity there; limit in standard errors of the median
_DIM, _SURE = 0.05, 3.0
# number of rows and columns around a pixel, and of columns in its own row, that decide whether it is in a shadow
SHADOW_REACH = 5
_WHOLE = 0.9  # share of the pixels of a row that must be dark, because noise makes some pixels bright
_UNLIT = 0.01  # a pixel below this share of the intensity in the full beam is outside the beam
_BRIGHT = 90.0  # percentile of a flat that shows the full beam


def dead_pixels(dark: Image, flats: Sequence[Image], hot_threshold: float = 10.0) -> Mask:
    """Mask [row, col] of unusable pixels: not finite, without signal (flat near dark), or unlike their neighbours.

    Raises:
        ValueError: more than half of the detector is dead, because there is no beam or darks and flats are exchanged.
    """
    dark = np.asarray(dark, np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        nets = [np.asarray(flat, np.float32) - dark for flat in flats]
    dead = np.logical_or.reduce([~((net > 0) & np.isfinite(net)) for net in nets])
    if dead.mean() > 0.5:
        raise ValueError(
            f"the flats show no beam, or darks and flats are exchanged: {dead.mean():.0%} of the pixels have flat <= "
            f"dark (median flat {np.median(flats[0]):.4g}, median dark {np.median(dark):.4g})"
        )
    # Behind a slit, flat and projection contain only noise, and their ratio has no meaning.
    dead = np.logical_or.reduce([dead, *(net < _UNLIT * np.percentile(net[~dead], _BRIGHT) for net in nets)])
    response = np.median([np.median(net[~dead]) for net in nets])

    def outliers(image: Image, least: float) -> Mask:
        filled = np.where(dead, np.median(image[~dead]), image)
        difference = filled - ndimage.median_filter(filled, 3, mode="nearest")
        return np.abs(difference) > hot_threshold * max(median_deviation(difference), least)

    # Smaller deviations (of the dark, below 1 % of the beam; of the response, below 10 %) are corrected by the division
    # by the flat.
    hot = outliers(dark, 1e-3 * float(response))
    for net in nets:
        filled = np.where(dead, response, net)
        hot |= outliers(filled / ndimage.median_filter(filled, 3, mode="nearest"), 0.01)
    return dead | hot


def shadowed(transmission: NDArray[np.float32], floor: float = 1e-4) -> Mask:
    """Mask [row, col] of areas that have beam in the flats but in no projection, because a part of the instrument is in
    the beam.

    Only runs of dark pixels from an edge of their row count, and rows that are completely dark. So an opaque rod on the
    rotation axis, which darkens the middle, does not count. Opaque material that covers an edge in all projections
    counts as a shadow, because its line integrals cannot be measured anyway. The blurred edge of the area is included,
    see `with_rim`.

    Args:
        transmission: float32 [view, row, col], of at least three projections from all directions.
        floor: lowest transmission that counts as beam.
    """
    n = len(transmission)
    middle = np.median(transmission, axis=0)
    deviation = np.median(np.abs(transmission - middle), axis=0) / MEDIAN
    dark = middle < np.maximum(floor, _SURE * deviation / np.sqrt(n))
    second_brightest = np.partition(transmission, n - 2, axis=0)[n - 2]  # a single projection may have a zinger
    dark &= second_brightest < _DIM
    dark_rows = dark.mean(axis=1) > _WHOLE  # rows that the camera does not read have no blurred edge
    block = np.ones((3, 3))
    dark = ndimage.binary_opening(ndimage.binary_closing(np.pad(dark, 2, mode="edge"), block), block)[2:-2, 2:-2]
    left, right = (np.logical_and.accumulate(side, axis=1) for side in (dark, dark[:, ::-1]))
    shadow = left | right[:, ::-1]
    return with_rim(shadow, second_brightest) | dark_rows[:, None]


_NEXT, _OUTER = 5, 3  # number of projections next to flats; number of columns
# rise of the line integral from the edge to an eighth of the width; about the smallest rise that a beam background
# causes
_RISE = 0.005
_BANDS = 8  # largest number of bands of rows


def edge_profiles(transmission: F32) -> F32:
    """Input of `air_columns`, computed from transmissions [view, row, col]: medians [view, side, band of rows, column
    from the edge]."""
    _, rows, cols = transmission.shape
    bands = [b for b in np.array_split(np.arange(rows), min(rows, _BANDS)) if b.size]
    widest = max(cols // 8, 1)
    sides = (transmission[:, :, :widest], transmission[:, :, ::-1][:, :, :widest])
    return np.stack(
        [np.stack([np.median(side[:, b[:: max(b.size // 32, 1)]], axis=1) for b in bands], axis=1) for side in sides],
        axis=1,
    )


def air_columns(profiles: F32, cols: int, tolerance: float = 0.03) -> tuple[int, int]:
    """Number of columns at the left and at the right edge that show air in all projections; (0, 0) if there are none.

    A column counts as air if it is nowhere darker than the outermost columns by more than the tolerance (or the noise,
    if that is larger). This must be true in every projection, over the whole height. A sample that fills the field of
    view is thinnest at the edge. So if columns become darker inwards, the cause is the sample; if they become slowly
    brighter, the cause is the beam. A side counts as 0 if it has fewer than 4 % of the columns, or if it is darker than
    the other side by more than 10 %. `profiles` are the `edge_profiles` of all projections.
    """
    least = max(3, cols // 25)
    n_columns, levels = [], []
    for profile in (profiles[:, 0], profiles[:, 1]):
        level = np.median(profile[:, :, :3], axis=(1, 2))
        relative = profile / np.where(level > 0, level, 1e-30)[:, None, None] - 1
        noise = deviation_between_neighbours(relative)
        # One projection in twenty may deviate, because noise has tails. The median over the columns tolerates this.
        darkest = np.quantile(relative.min(axis=1), 0.05, axis=0, method="higher")
        steady = (darkest > -max(tolerance, 4 * noise)) & (np.median(relative, axis=(0, 1)) < 0.1)
        n = int(np.argmin(np.append(steady, False)))
        n -= n // 4  # keep a distance from the sample's edge and its phase fringes
        trend = np.median(relative[:, :, n // 2 : n]) - np.median(relative[:, :, : n // 2]) if n > 1 else -np.inf
        n_columns.append(n if n >= least and trend > -tolerance / 2 else 0)
        levels.append(float(np.median(level)))
    left, right = (n if level > 0.9 * max(levels) else 0 for n, level in zip(n_columns, levels, strict=True))
    return left, right


def edge_depth(profiles: F32, positions: NDArray[np.int64], flats: Sequence[float], columns: tuple[int, int]) -> float:
    """Line integral at edges that look like air but may show a sample wider than the field of view. 0: the edges show
    air.

    The line integral is measured in the projections next to each group of flats, because near its flats the beam has
    not drifted, whereas a sample is there from the start. The smallest value of all groups counts. A sample is thinnest
    at the edges, so the median line integrals rise from the edge inwards on all sides. If they do not rise, the beam is
    weaker than in the flats.

    Args:
        profiles: from `edge_profiles`; positions: [view], positions of the projections in the scan.
        flats: positions of the groups of flats.
        columns: number of columns that show air, left and right.
    """
    sides = [side for side, n in enumerate(columns) if n]
    levels = np.median(profiles[:, sides, :, :_OUTER], axis=(1, 2, 3))
    views_near_flats = (np.argsort(np.abs(positions - flat), kind="stable")[:_NEXT] for flat in flats)
    depth = min(-math.log(max(float(np.median(levels[views])), 1e-30)) for views in views_near_flats)
    outer, inner = (np.median(part, axis=(0, 2, 3)) for part in (profiles[..., :_OUTER], profiles[..., -_OUTER:]))
    rises = np.log(np.maximum(outer, 1e-30) / np.maximum(inner, 1e-30))[sides]
    return depth if rises.min() > _RISE else 0.0


def air_transmission(transmission: F32, left: int, right: int) -> F32:
    """Transmission of the air across each projection [view, col], computed from its air columns; 1 if there are no air
    columns.

    The transmission is the straight line through the medians of both sides. The line is sloped if the beam moved or
    changed its shape since the flat.
    """
    views, _, cols = transmission.shape
    sides = [(side, middle) for side, middle in (
        (transmission[:, :, :left], (left - 1) / 2), (transmission[:, :, cols - right :], cols - (right + 1) / 2),
    ) if side.shape[2]]  # fmt: skip
    if not (sides and views):
        return np.ones((views, cols), np.float32)
    levels = [np.median(side, axis=(1, 2)).astype(np.float32) for side, _ in sides]
    if len(sides) == 1:
        return np.repeat(levels[0][:, None], cols, axis=1)
    first, last = (middle for _, middle in sides)
    right_weight = np.clip((np.arange(cols) - first) / (last - first), 0, 1).astype(np.float32)
    return levels[0][:, None] * (1 - right_weight) + levels[1][:, None] * right_weight
