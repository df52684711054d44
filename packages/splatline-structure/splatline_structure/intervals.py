"""Computes intervals of numbers (value, low end, high end) from four sources of error: projections, levels, voxels and
particles.
"""

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
"""Half-width from few projections, as factors: of the change when half of the projections is left out, and of half the
difference between the two halves."""
PROBED, PARTIAL = 0.05, 0.012
"""Fractions of the gap between two levels: by how much thresholds are moved to see their effect, and by how much they
may be wrong because of partial-volume voxels."""
OF_KIND = {"fraction": (0.5, 0.3), "surface": (0.5, 0.2), "size": (0.0, 0.05), "tortuosity": (0.0, 0.04)}
"""Two factors for each number, by the first word of its name. The first, times the change from half of the projections
to all, estimates the change from all to infinitely many. The second, times the change from voxels twice as wide, is the
half-width from the voxels. OTHERS is used for other numbers, and its second factor for voxels that are not cubes. All
values here were found on simulated grains and checked once on other grains (docs/structure.md). Sizes and tortuosities
changed in both directions.
"""
OTHERS = 0.5, 0.3
BIAS = 0.012  # relative; fractions of grains, or of the rest, are too low by this share for any number of projections
SPLIT_OR_MERGED = 0.62
"""Factor for the error because some of n whole particles are split, merged or cut in another way than in the sample.

The fraction s of their volume below a size is therefore wrong by this value times √(s (1 - s) / n). Found on twenty
scenes (docs/structure.md).
"""
LEVELS_MOVE = 0.5  # error of thresholds, as a factor on their change with half of the projections
UNDECIDED, SURE = 0.15, 0.8
"""Largest fraction of undecided voxels; a voxel is decided if one material has this probability or more."""
# shares of the value: widest interval of a number that counts as determined; smallest half-width
WIDEST, NARROWEST = 0.5, 0.001
CAUSES = {
    "views": "more projections would narrow the interval",
    "levels": "the threshold sets the width of the interval; more projections would not help",
    "voxels": "the voxel size sets the width of the interval; more projections would not help",
    "particles": "more whole particles (a larger field of view) would narrow the interval",
}
_NO_CAUSE = (
    "no source of error changes the number, so the interval has the smallest width that the command gives "
    f"({100 * NARROWEST:g} % to each side)"
)
_SHARES = "fraction", "sphericity", "cracks", "connected"


@dataclass(frozen=True)
class Interval:
    """A number with its interval of a nominal 80 %.

    Attributes:
        low, high: ends of the interval around the value that infinitely many projections would give.
        moves: extrapolated change of the value with more projections; NaN: there were no halves of the projections.
        views, levels, voxels, particles: half-width from each cause.
        why_not: why the number is not determined; empty: the number is determined.
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
        """What limits the interval, or why there is no interval."""
        return self.why_not or (CAUSES[self.decides] if getattr(self, self.decides) > 0 else _NO_CAUSE)


@dataclass(frozen=True, eq=False)
class MeasuredStructure:
    """The structure of a volume, with the intervals of its numbers.

    Attributes:
        intervals: intervals by the names of `Structure.numbers`, and by those of `with_all_slices`.
        undecided: fraction of voxels in which no material has a probability of 0.8.
        unsure: bool [z, y, x], True for these voxels.
        parts: structures of the volumes from parts of the projections.
        off: error of the thresholds, as a fraction of the gap between levels.
        rules: how the numbers were measured.
        spacing: edges of a voxel (z, y, x), µm.
        along_all: fraction of the particles' material in each slice, including slices that were not measured.
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


def measured_structure(
    volume: F32,
    parts: Sequence[F32],
    count: int,
    spacing: Spacing,
    rules: Rules,
    tell: Callable[[int, int], None] = lambda n, total: None,
) -> MeasuredStructure:
    """The structure of a volume, with the intervals of its numbers.

    Args:
        parts: the same volume from interleaved parts of its projections; empty: the intervals leave them out.
        count: number of materials.
        tell: function that is called with the number of structures measured and the number of all structures.

    Raises:
        ValueError: there is no contrast between materials.
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
                "take more projections or photons: a volume from half of the projections has no contrast between the "
                "materials"
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
        why = f"take more projections or photons: {undecided:.0%} of the voxels could be of either material"
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
    return MeasuredStructure(whole, materials, intervals, undecided, unsure, tuple(halves), off, rules, spacing)


def _of_particles(name: str, particles: Particles) -> float:
    """Half-width of a quantile of sizes, because particles are split, merged or cut in another way; 0 for other
    numbers, infinite for a single whole particle."""
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
            "nothing connects the two faces within the material"
            if math.isinf(value)
            else "no particle is completely in the measured box"
        )
        return Interval(value, why_not=nothing if kind != "connected" else "there are no voxels of this material")
    if of_particles == math.inf:
        return Interval(
            value, why_not="only one particle is completely in the box, so there is no distribution of sizes"
        )
    if not all(map(math.isfinite, (*halves, *sides, wide))):
        return Interval(
            value,
            why_not=(
                "the number can be computed only with some of the thresholds, halves of the projections or voxel "
                "sizes that were tried"
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
    """The interval with its ends, limited to possible values; not determined if it is too wide."""
    by_cause = [float(np.nan_to_num(getattr(interval, cause))) for cause in CAUSES]
    half = max(math.hypot(*by_cause), NARROWEST * abs(interval.value))
    middle = interval.value + float(np.nan_to_num(interval.moves))
    low = max(middle - half, 1.0 if kind == "tortuosity" else 0.0)
    high = min(middle + half, 1.0 if kind in _SHARES else math.inf)
    why = f"the interval is {low:.3g} to {high:.3g}, wider than half of the value"
    return replace(interval, low=low, high=high, why_not=why if high - low > WIDEST * abs(interval.value) else "")


def with_all_slices(measured: MeasuredStructure, slabs: Iterable[F32]) -> MeasuredStructure:
    """Add fractions and surface of all slices, named `_all`, with the half-widths of the measured slices.

    Args:
        slabs: all slices, some at a time. Each slab except the first begins with the last slice of the slab before,
            because surface may lie between them.
    """
    count, surfaces, shares, pairs = measured.materials.levels.size, list[float](), list[F64](), list[int]()
    for slab in slabs:
        labels = labelled(slab, measured.materials.thresholds)
        surfaces.append(shares_of(labels, count, measured.spacing, measured.rules)["surface"])
        pairs.append(len(slab) - 1)
        own = labels[1:] if shares else labels
        shares.append(np.array([(own == k).mean(axis=(1, 2)) for k in range(count)]))
    along, intervals = np.concatenate(shares, axis=1), dict(measured.intervals)
    numbers = {
        **{f"fraction_{k}": float(share) for k, share in enumerate(along.mean(axis=1), 1)},
        "surface": float(np.average(surfaces, weights=pairs)),
    }
    for name, value in numbers.items():
        of_all = replace(measured.intervals[name], value=value)
        # Without ends no number is determined, for a reason that holds for all slices.
        intervals[f"{name}_all"] = of_all if math.isnan(of_all.low) else _judged(name.split("_")[0], of_all)
    return replace(measured, intervals=intervals, along_all=along[measured.rules.particles - 1])


def difference(first: Interval, second: Interval) -> Interval:
    """The change between two states: the second minus the first. The squares of the half-widths are added, also for
    each cause.
    """
    value, middle = second.value - first.value, (second.high + second.low - first.high - first.low) / 2
    half = math.hypot((first.high - first.low) / 2, (second.high - second.low) / 2)
    causes: dict[str, Any] = {cause: math.hypot(getattr(first, cause), getattr(second, cause)) for cause in CAUSES}
    alike = "the change is smaller than its uncertainty" if abs(middle) < half else ""
    return Interval(
        value, middle - half, middle + half, second.moves - first.moves,
        why_not=first.why_not or second.why_not or alike, **causes,
    )  # fmt: skip
