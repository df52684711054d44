"""correct: counts to line integrals by dark and flat; dead pixels, beam drift and zingers; then -log with a floor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.base.masks import NEIGHBOURS, Image, Mask, fill, plan_fill

_MAD = 1.4826  # median absolute deviation to standard deviation of a normal distribution
_UNLIT = 0.01  # of the light on well-lit pixels: below it a pixel is unlit


@dataclass(frozen=True, eq=False)
class References:
    """Darks and flats: the images without beam, and with beam but without a sample.

    Attributes:
        dark: float32 [row, col], mean or median of the darks.
        flats: (position, float32 [row, col]) of each group of flats; the position counts frames of the scan.
    """

    dark: Image
    flats: tuple[tuple[float, Image], ...]


@dataclass(frozen=True)
class CorrectionSettings:
    """Settings of the correction from counts to line integrals.

    Attributes:
        floor: lowest transmission; below it, also for zero and negative values, the line integral is -log(floor).
        hot_threshold: robust standard deviations by which a pixel's dark, or its response to the beam, must differ from
            its neighbours to be masked; inf masks none.
        zinger_threshold: robust standard deviations by which a pixel must be brighter than its neighbours, and than
            itself in the neighbouring views, to be replaced; inf replaces none.
        air: columns (left, right) that see no sample in any view and are scaled to a transmission of 1, or "auto" to
            find them, or "none".
    """

    floor: float = 1e-4
    hot_threshold: float = 10.0
    zinger_threshold: float = 8.0
    air: Literal["none", "auto"] | tuple[int, int] = "auto"

    def __post_init__(self) -> None:
        if not 0 < self.floor < 1:
            raise ValueError(f"floor is a transmission between 0 and 1, got {self.floor}")
        if not (self.hot_threshold > 0 and self.zinger_threshold > 0):
            raise ValueError(
                f"thresholds must be positive (inf turns one off), got hot {self.hot_threshold}, "
                f"zinger {self.zinger_threshold}"
            )


@dataclass(frozen=True, eq=False)
class Projections:
    """Line integrals, and what the correction changed.

    Attributes:
        data: float32 [view, row, col], dimensionless, finite.
        view_ids: int64 [view].
        floored: fraction of the live pixels that were set to -log(floor).
        air: float32 [view], transmission of the air columns, by which each view was divided; 1 without air columns.
        masked: bool [row, col], dead and hot pixels, filled from their neighbours in every view.
        air_columns: (left, right) number of columns in which `air` was measured; (0, 0): none.
        replaced: fraction of the live pixels that were zingers or not finite in one view; filled from their neighbours.
    """

    data: NDArray[np.float32]
    view_ids: NDArray[np.int64]
    floored: float
    air: NDArray[np.float32]
    masked: Mask
    air_columns: tuple[int, int] = (0, 0)
    replaced: float = 0.0


def dead_pixels(references: References, hot_threshold: float = CorrectionSettings.hot_threshold) -> Mask:
    """Mask [row, col] of unusable pixels: not finite, blind or unlit (flat near dark), or unlike their neighbours.

    Raises:
        ValueError: where more than half of the detector is dead: no beam, or darks and flats exchanged.
    """
    dark = np.asarray(references.dark, np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        nets = [np.asarray(flat, np.float32) - dark for _, flat in references.flats]
    dead = np.logical_or.reduce([~((net > 0) & np.isfinite(net)) for net in nets])
    if dead.mean() > 0.5:
        raise ValueError(
            f"{dead.mean():.0%} of the pixels have flat <= dark (median flat {np.median(references.flats[0][1]):.4g}, "
            f"median dark {np.median(dark):.4g}): no beam in the flats, or darks and flats exchanged"
        )
    # Behind a slit, flat and view are both noise, and their ratio has no meaning.
    dead = np.logical_or.reduce([dead, *(net < _UNLIT * np.percentile(net[~dead], 90) for net in nets)])
    response = np.median([np.median(net[~dead]) for net in nets])

    def outliers(image: Image, least: float) -> Mask:
        filled = np.where(dead, np.median(image[~dead]), image)
        difference = np.abs(filled - ndimage.median_filter(filled, 3, mode="nearest"))
        sigma = max(_MAD * float(np.median(difference)), least)
        return difference > hot_threshold * sigma

    # Smaller deviations (dark below 1 % of the beam, response below 10 %) are corrected by the division.
    hot = outliers(dark, 1e-3 * float(response))
    for net in nets:
        filled = np.where(dead, response, net)
        hot |= outliers(filled / ndimage.median_filter(filled, 3, mode="nearest"), 0.01)
    return dead | hot


def _flat_at(position: float, groups: list[tuple[float, Image]]) -> Image:
    """Net flat at a frame's position: interpolated between groups, the nearest group outside."""
    at = [p for p, _ in groups]
    upper = int(np.searchsorted(at, position))
    if upper == 0 or upper == len(groups):
        return groups[min(upper, len(groups) - 1)][1]
    weight = np.float32((position - at[upper - 1]) / (at[upper] - at[upper - 1]))
    return groups[upper - 1][1] * (1 - weight) + groups[upper][1] * weight


def air_columns(transmission: NDArray[np.float32], tolerance: float = 0.03) -> tuple[int, int]:
    """Number of columns at the left and right edge that show air in all views; (0, 0) if none do.

    Air columns are nowhere darker than the outermost ones by more than the tolerance (or the noise, if larger), in
    every view and over the whole height. A sample that fills the view is thinnest at the edge, so a trend towards
    darker is sample; a slow trend towards brighter is the beam. A side of fewer than 4 % of the columns, or darker than
    the other side by more than 10 %, counts as 0.

    Args:
        transmission: float32 [view, row, col].
    """
    _, rows, cols = transmission.shape
    bands = [b for b in np.array_split(np.arange(rows), min(rows, 8)) if b.size]
    widest, least = max(cols // 8, 1), max(3, cols // 25)
    counts, levels = [], []
    for side in (transmission[:, :, :widest], transmission[:, :, ::-1][:, :, :widest]):
        profile = np.stack([np.median(side[:, b[:: max(b.size // 32, 1)]], axis=1) for b in bands], axis=1)
        level = np.median(profile[:, :, :3], axis=(1, 2))
        relative = profile / np.where(level > 0, level, 1e-30)[:, None, None] - 1
        noise = _MAD * float(np.median(np.abs(np.diff(relative, axis=2)))) / np.sqrt(2) if widest > 1 else 0.0
        # One view in twenty may deviate: the median over the columns tolerates that, and noise has tails.
        darkest = np.quantile(relative.min(axis=1), 0.05, axis=0, method="higher")
        steady = (darkest > -max(tolerance, 4 * noise)) & (np.median(relative, axis=(0, 1)) < 0.1)
        n = int(np.argmin(np.append(steady, False)))
        n -= n // 4  # keep a distance from the sample's edge and its phase fringes
        trend = np.median(relative[:, :, n // 2 : n]) - np.median(relative[:, :, : n // 2]) if n > 1 else -np.inf
        counts.append(n if n >= least and trend > -tolerance / 2 else 0)
        levels.append(float(np.median(level)))
    left, right = (n if level > 0.9 * max(levels) else 0 for n, level in zip(counts, levels, strict=True))
    return left, right


def _air(transmission: NDArray[np.float32], left: int, right: int) -> NDArray[np.float32]:
    """Median transmission of the air columns in each view, with equal weight for both sides."""
    cols = transmission.shape[2]
    sides = [side for side in (transmission[:, :, :left], transmission[:, :, cols - right :]) if side.shape[2]]
    if not sides:
        return np.ones(transmission.shape[0], np.float32)
    return np.mean([np.median(side, axis=(1, 2)) for side in sides], axis=0).astype(np.float32)


def _around(image: Image, r: NDArray[np.intp], c: NDArray[np.intp]) -> tuple[Image, Image]:
    """Median and third brightest of the eight neighbours of each (r, c); at the image edge the brightest."""
    rows, cols = image.shape
    nr, nc = r[:, None] + NEIGHBOURS[:, 0], c[:, None] + NEIGHBOURS[:, 1]
    inside = (nr >= 0) & (nr < rows) & (nc >= 0) & (nc < cols)
    values = np.where(inside, image[np.clip(nr, 0, rows - 1), np.clip(nc, 0, cols - 1)], np.float32(np.nan))
    values.sort(axis=1)  # NaN, the places outside, come last
    n, at = inside.sum(axis=1), np.arange(r.size)
    return (values[at, (n - 1) // 2] + values[at, n // 2]) / 2, values[at, np.where(n == 8, 5, n - 1)]


def _zingers(view: Image, others: list[Image], threshold: float) -> tuple[NDArray[np.intp], NDArray[np.intp], Image]:
    """Pixels (r, c) hit by a stray photon, and the median around each.

    Compared in √transmission, where photon noise is uniform. A bright feature of the sample is also in the neighbouring
    views, or is larger than the two or three pixels of a zinger; a zinger is brighter than both.
    """
    root = np.sqrt(np.maximum(view, 0))
    step = max(1, int(np.sqrt(view.size / 4096)))
    r, c = (a.ravel() for a in np.meshgrid(*(np.arange(0, n, step) for n in view.shape), indexing="ij"))
    spread = root[r, c] - _around(root, r, c)[0]
    limit = threshold * max(_MAD * float(np.median(np.abs(spread))), 0.005)
    before = np.sqrt(np.maximum(np.maximum.reduce(others), 0)) if others else np.zeros_like(root)
    r, c = np.nonzero(root > before + limit)
    middle, brightest = _around(root, r, c)
    spikes = root[r, c] > brightest + limit
    return r[spikes], c[spikes], middle[spikes] ** 2


def correct(
    counts: NDArray[np.generic],
    positions: NDArray[np.float64],
    references: References,
    settings: CorrectionSettings | None = None,
    view_ids: NDArray[np.int64] | None = None,
    masked: Mask | None = None,
) -> Projections:
    """Line integrals -log((counts - dark) / (flat - dark)) of a stack of views.

    All results are finite: dead pixels and single bad values take the mean of their good neighbours and are counted.
    Memory beyond the result: a few frames.

    Args:
        counts: [view, row, col], any real type, in the order of acquisition.
        positions: [view], number of the frame in the scan, as in the flats' positions.
        references: darks and flats of the same detector area.
        settings: None: the defaults.
        view_ids: int64 [view]; None: 0, 1, 2 ...
        masked: bool [row, col], pixels to fill, from an earlier part of the same scan; None: `dead_pixels(references)`.

    Raises:
        ValueError: for shapes that disagree, no flats, no beam in the flats, or unusable views, whose numbers it gives.
    """
    settings = CorrectionSettings() if settings is None else settings
    _check(counts, positions, references, settings)
    for name, given, shape in (("view_ids", view_ids, counts.shape[:1]), ("masked", masked, counts.shape[1:])):
        if given is not None and np.shape(given) != shape:
            raise ValueError(f"{name} must have shape {shape}, got {np.shape(given)}")
    dead = dead_pixels(references, settings.hot_threshold) if masked is None else masked
    data, replaced = _transmission(counts, positions, references, dead)
    left, right = air_columns(data) if settings.air == "auto" else (0, 0) if settings.air == "none" else settings.air
    air = _air(data, left, right)
    unlit = np.flatnonzero(~(air > settings.floor))
    if unlit.size:
        raise ValueError(
            f"no beam in {unlit.size} of {air.size} views ({unlit[:8].tolist()} ...): the air columns, {left} left and "
            f"{right} right, are dark; leave these views out"
        )
    data /= air[:, None, None]
    if np.isfinite(settings.zinger_threshold):
        for v in range(len(data)):
            others = [data[w] for w in (v - 1, v + 1) if 0 <= w < len(data)]
            r, c, value = _zingers(data[v], others, settings.zinger_threshold)
            data[v, r, c] = value
            replaced += r.size
    floored = 0
    for view in data:
        low = view < settings.floor
        floored += int((low & ~dead).sum())
        view[low] = settings.floor
        np.negative(np.log(view, out=view), out=view)
    ids = np.arange(len(data), dtype=np.int64) if view_ids is None else np.asarray(view_ids, np.int64)
    live = max(int((~dead).sum()) * len(data), 1)
    return Projections(data, ids, floored / live, air, dead, (left, right), replaced / live)


def _transmission(
    counts: NDArray[np.generic], positions: NDArray[np.float64], references: References, dead: Mask
) -> tuple[NDArray[np.float32], int]:
    """(counts - dark) / (flat - dark) with bad pixels filled, and the number of pixels bad in one view only."""
    dark = np.asarray(references.dark, np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        groups = [
            (position, np.where(dead, np.float32(1), np.asarray(flat, np.float32) - dark))
            for position, flat in sorted(references.flats, key=lambda group: group[0])
        ]
    data = np.empty(counts.shape, np.float32)
    plan = plan_fill(dead)
    replaced = 0
    for v, view in enumerate(data):
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            np.subtract(counts[v], dark, out=view, casting="unsafe")
            view /= _flat_at(float(positions[v]), groups)
        bad = ~np.isfinite(view) & ~dead
        n = int(bad.sum())
        if n == 0:
            fill(view, plan)
            continue
        if n > view.size / 2:
            raise ValueError(f"view {v}: {n} of {view.size} pixels are not finite; leave this view out")
        fill(view, plan_fill(bad | dead))
        replaced += n
    return data, replaced


def _check(
    counts: NDArray[np.generic], positions: NDArray[np.float64], references: References, settings: CorrectionSettings
) -> None:
    if counts.ndim != 3 or counts.size == 0:
        raise ValueError(f"counts must be [view, row, col] with at least one view, got shape {counts.shape}")
    views, shape, cols = counts.shape[0], counts.shape[1:], counts.shape[2]
    if np.shape(positions) != (views,):
        raise ValueError(f"positions must hold one number for each of {views} views, got shape {np.shape(positions)}")
    if not np.isfinite(positions).all():
        raise ValueError(
            f"the positions of views {np.flatnonzero(~np.isfinite(positions))[:8].tolist()} are not finite"
        )
    if not references.flats:
        raise ValueError("there is no flat: without one, counts cannot be converted to line integrals")
    for name, image in [("dark", references.dark), *((f"flat at {p:g}", flat) for p, flat in references.flats)]:
        if image.shape != shape:
            raise ValueError(f"{name} has shape {image.shape}, the views {shape}")
    at = sorted(p for p, _ in references.flats)
    if len(set(at)) < len(at) or not np.isfinite(at).all():
        raise ValueError(f"each group of flats needs a position of its own, got {at}; average the flats taken together")
    if isinstance(settings.air, tuple) and not (min(settings.air) >= 0 and 0 < sum(settings.air) <= cols):
        raise ValueError(f"air columns (left, right) {settings.air} do not fit {cols} columns")
