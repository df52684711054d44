"""Intervals: each number as value, low and high, by the views, levels, voxels and particles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from splatline_structure.materials import F32, F64, Materials, Spacing, labelled, materials_of, probabilities
from splatline_structure.numbers import Rules, Structure, coarse, shares_of, structure_of
from splatline_structure.particles import Particles

BIAS_UNSURE, NOISE = 0.5, 1.5
"""Half-width by the views: over what half of them change a number by, and over half the difference of both halves."""
PROBED, PARTIAL = 0.05, 0.012
"""Of the gap of two levels: by how much thresholds are moved to see what they do, and may lie off by partial voxels."""
OF_KIND = {"fraction": (0.5, 0.3), "surface": (0.5, 0.2), "size": (0.0, 0.05), "tortuosity": (0.0, 0.04)}
"""By the first word of a number's name: what all views would still change it by, over what half of them do, and the
half-width over what voxels twice as wide change it by; of others, and of voxels that are no cubes, OTHERS. Found,
as the figures above, on simulated grains, and looked at once on others (docs/structure.md). Sizes and tortuosities
moved either way."""
OTHERS = 0.5, 0.3
BIAS = 0.012  # of a fraction, or of all the rest: by so much fractions of grains come out low, however many the views
SPLIT_OR_MERGED = 0.62
"""Of n whole particles some are split, merged or cut otherwise than in the sample: the share s of their volume below a
size lies off by this times √(s (1 - s) / n). Found on twenty scenes (docs/structure.md)."""
LEVELS_MOVE = 0.5  # thresholds, over what half of the views move them by
UNDECIDED, SURE = 0.15, 0.8
"""Most voxels that may be undecided, and the probability of one material from which on a voxel is decided."""
WIDEST, NARROWEST = 0.5, 0.001  # of the value: a wider interval determines no number, and none is narrower to a side
CAUSES = {
    "views": "more views would narrow this",
    "levels": "the threshold decides this, not the views",
    "voxels": ("the interval is this wide because of the voxel size, not because of the projections"),
    "particles": ("a larger field of view with more complete particles would narrow the interval"),
}
_NO_CAUSE = (
    f"none of the causes of error changes this number, so the narrowest interval is given ({100 * NARROWEST:g} "
    "% to a side)"
)
_SHARES = "fraction", "sphericity", "cracks", "connected"


@dataclass(frozen=True)
class Interval:
    """A number with its interval of a nominal 80 %.

    Attributes:
        low, high: around the value as it would be with all views there could be.
        moves: what more views would still change the value by, extrapolated; NaN: the views were not parted.
        views, levels, voxels, particles: half-widths by each cause.
        why_not: why the number is not determined; empty: it is.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    moves: float = math.nan
    views: float = math.nan
    levels: float = math.nan
    voxels: float = math.nan
    particles: float = math.nan
    why_not: str = ""

    @property
    def decides(self) -> str:
        """The cause of the largest half-width."""
        return max(CAUSES, key=lambda cause: np.nan_to_num(getattr(self, cause), nan=-1.0))

    @property
    def words(self) -> str:
        """What the interval comes from, or why there is none."""
        return self.why_not or (CAUSES[self.decides] if getattr(self, self.decides) > 0 else _NO_CAUSE)


@dataclass(frozen=True, eq=False)
class Found:
    """All that a volume says of its structure.

    Attributes:
        intervals: by the names of `Structure.numbers`, and those of `with_all_slices`.
        undecided: share of voxels without a material of probability 0.8.
        unsure: bool [z, y, x], these voxels.
        parts: structures of volumes from parts of the views.
        off: share of a gap of levels by which thresholds may lie off.
        rules: by which the numbers were taken.
        spacing: edges of a voxel (z, y, x), µm.
        along_all: share of the particles' material in each slice, also of those beyond the ones looked at.
    """

    structure: Structure
    materials: Materials
    intervals: dict[str, Interval]
    undecided: float
    unsure: np.ndarray
    parts: tuple[Structure, ...]
    off: float
    rules: Rules
    spacing: Spacing
    along_all: F64 | None = None


def found_in(
    volume: F32,
    parts: Sequence[F32],
    count: int,
    spacing: Spacing,
    rules: Rules,
    tell: Callable[[int, int], None] = lambda n, of: None,
) -> Found:
    """The structure of a volume, its numbers with intervals.

    Args:
        parts: the same volume from interleaved parts of its views; none: the views are no part of the intervals.
        count: of materials.
        tell: gets structures taken, and all.

    Raises:
        ValueError: no contrast between materials.
    """
    steps, why = 4 + len(parts), ""
    tell(0, steps)
    materials = materials_of(volume, count)
    gaps = np.diff(materials.levels)
    whole = structure_of(volume, materials.thresholds, spacing, rules)
    tell(1, steps)
    halves, moved = [], [0.0] * (not parts)
    for part in parts:
        try:
            thresholds = materials_of(part, count).thresholds
        except ValueError:
            why = (
                "with half of the projections the materials cannot be distinguished: more projections or photons are "
                "needed"
            )
            thresholds = materials.thresholds
        moved.append(float(np.abs((thresholds - materials.thresholds) / gaps).max()))
        halves.append(structure_of(part, thresholds, spacing, rules))
        tell(1 + len(halves), steps)
    sides = [
        structure_of(volume, materials.thresholds + sign * PROBED * gaps, spacing, rules).numbers for sign in (1, -1)
    ]
    tell(3 + len(halves), steps)
    dz, dy, dx = spacing
    wide = structure_of(coarse(volume), materials.thresholds, (2 * dz, 2 * dy, 2 * dx), rules.of_coarse_voxels).numbers
    tell(steps, steps)
    errors = np.hypot(materials.errors[1:], materials.errors[:-1]) / gaps
    off = math.hypot(PARTIAL, float(errors.max()), LEVELS_MOVE * float(np.mean(moved)))
    unsure = probabilities(volume, materials.thresholds, float(materials.spread.max())).max(axis=0) < SURE
    undecided = float(unsure.mean())
    if undecided > UNDECIDED:
        why = f"{undecided:.0%} of the voxels could be either material: more projections or photons are needed"
    intervals = {
        name: Interval(value, why_not=why)
        if why
        else _interval(
            name,
            value,
            [half.numbers[name] for half in halves],
            [side[name] for side in sides],
            wide[name],
            off,
            _of_particles(name, whole.particles),
            max(spacing) < 1.05 * min(spacing),
        )
        for name, value in whole.numbers.items()
    }
    return Found(whole, materials, intervals, undecided, unsure, tuple(halves), off, rules, spacing)


def _of_particles(name: str, particles: Particles) -> float:
    """Half-width of a quantile of sizes, as particles split, merge or are cut otherwise; 0 of another number, infinite
    of a single whole particle."""
    kind, _, percent = name.partition("_")
    if kind != "size" or particles.cut.all():
        return 0.0
    if np.count_nonzero(~particles.cut) == 1:
        return math.inf
    share = int(percent) / 100
    off = SPLIT_OR_MERGED * math.sqrt(share * (1 - share) / np.count_nonzero(~particles.cut))
    return (particles.quantile(share + off) - particles.quantile(share - off)) / 2


def _interval(
    name: str,
    value: float,
    halves: Sequence[float],
    sides: Sequence[float],
    wide: float,
    off: float,
    of_particles: float,
    cubes: bool,
) -> Interval:
    kind = name.split("_")[0]
    if not math.isfinite(value):
        nothing = (
            "nothing connects the faces" if math.isinf(value) else "no particle is completely inside the field of view"
        )
        return Interval(value, why_not=nothing if kind != "connected" else "there is none of the material")
    if of_particles == math.inf:
        return Interval(value, why_not="only one particle is complete, so there is no distribution of sizes")
    if not all(map(math.isfinite, (*halves, *sides, wide))):
        return Interval(
            value,
            why_not=(
                "it exists or not depending on the threshold, on which half of the projections is used, or on the "
                "voxel size"
            ),
        )
    still, of_voxels = OF_KIND.get(kind, OTHERS) if cubes else (OF_KIND.get(kind, OTHERS)[0], OTHERS[1])
    change = value - float(np.mean(halves)) if halves else math.nan
    moves, views = still * change, math.hypot(BIAS_UNSURE * change, NOISE * float(np.ptp(halves or [0.0])) / 2)
    levels = abs(sides[0] - sides[1]) / 2 * off / PROBED
    voxels = math.hypot(of_voxels * abs(wide - value), BIAS * min(value, 1 - value) if kind == "fraction" else 0.0)
    return _judged(
        kind, Interval(value, moves=moves, views=views, levels=levels, voxels=voxels, particles=of_particles)
    )


def _judged(kind: str, interval: Interval) -> Interval:
    """With the ends by its half-widths, within what such a number can be; one that is too wide determines nothing."""
    by_cause = [float(np.nan_to_num(getattr(interval, cause))) for cause in CAUSES]
    half = max(math.hypot(*by_cause), NARROWEST * abs(interval.value))
    middle = interval.value + float(np.nan_to_num(interval.moves))
    low = max(middle - half, 1.0 if kind == "tortuosity" else 0.0)
    high = min(middle + half, 1.0 if kind in _SHARES else math.inf)
    why = f"the interval is {low:.3g} to {high:.3g}, wider than half of the value"
    return replace(interval, low=low, high=high, why_not=why if high - low > WIDEST * abs(interval.value) else "")


def with_all_slices(found: Found, slabs: Iterable[F32]) -> Found:
    """With fractions and surface of all slices, named `_all`, whose half-widths are those of the middle ones.

    Args:
        slabs: all slices, some at a time; each but the first begins with the last slice of the one before, as surface
            may lie between them.
    """
    count, surfaces, shares, pairs = found.materials.levels.size, list[float](), list[F64](), list[int]()
    for slab in slabs:
        labels = labelled(slab, found.materials.thresholds)
        surfaces.append(shares_of(labels, count, found.spacing, found.rules)["surface"])
        pairs.append(len(slab) - 1)
        own = labels[1:] if shares else labels
        shares.append(np.array([(own == k).mean(axis=(1, 2)) for k in range(count)]))
    along, intervals = np.concatenate(shares, axis=1), dict(found.intervals)
    numbers = {
        **{f"fraction_{k}": float(share) for k, share in enumerate(along.mean(axis=1), 1)},
        "surface": float(np.average(surfaces, weights=pairs)),
    }
    for name, value in numbers.items():
        of_all = replace(found.intervals[name], value=value)
        # Without ends nothing of the volume is determined, and why holds for all slices.
        intervals[f"{name}_all"] = of_all if math.isnan(of_all.low) else _judged(name.split("_")[0], of_all)
    return replace(found, intervals=intervals, along_all=along[found.rules.particles - 1])


def difference(one: Interval, other: Interval) -> Interval:
    """Of two states: the second less the first, with the intervals' half-widths added in squares, also by cause."""
    value, middle = other.value - one.value, (other.high + other.low - one.high - one.low) / 2
    half = math.hypot((one.high - one.low) / 2, (other.high - other.low) / 2)
    causes: dict[str, Any] = {cause: math.hypot(getattr(one, cause), getattr(other, cause)) for cause in CAUSES}
    alike = "no change is told from none" if abs(middle) < half else ""
    return Interval(
        value, middle - half, middle + half, other.moves - one.moves,
        why_not=one.why_not or other.why_not or alike, **causes,
    )  # fmt: skip
