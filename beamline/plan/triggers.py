"""Trigger trains: angles become pulses at whole counts of the stage, or an error says why not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base.protocols import TriggerTrain


@dataclass(frozen=True)
class Scale:
    """Radians at count 0, and radians a count, of a stage whose counts are linear in the angle."""

    origin: float
    per_count: float

    @classmethod
    def of(cls, to_counts: Callable[[float], int]) -> Scale:
        """The scale of a stage, from its own conversion, with its direction and its zero."""
        zero = to_counts(0.0)
        per_count = 2 * math.pi / (to_counts(2 * math.pi) - zero)
        return cls(-zero * per_count, per_count)

    def angles(self, counts: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.asarray(self.origin + counts * self.per_count, dtype=np.float64)


@dataclass(frozen=True)
class Flight:
    """Pulse trains of a fly scan."""

    trains: tuple[TriggerTrain, ...]  # one a pass, in the order of the views
    interval: int  # whole counts between neighbouring pulses of a pass (positive)
    step: int  # whole counts between neighbouring angles of all passes together
    exact: float  # the step without rounding
    drift: float  # largest shift of a view by the rounding, radians

    def counts(self) -> NDArray[np.int64]:
        """Count of every pulse, in the order of the views."""
        return np.concatenate([train.start + train.interval * np.arange(train.n) for train in self.trains])


def plan_flight(angles: NDArray[np.float64], to_counts: Callable[[float], int]) -> Flight:
    """Pulse trains for `angles` (float64 [view], radians, in order), their spacing rounded to whole counts.

    The angles must lie on one equally spaced lattice and fall into passes of equal steps, as fixed, sector and
    interlaced plans do. The lattice step, not each angle, is rounded: a trigger output counts a fixed distance.

    Raises:
        ValueError: one sentence that says why the plan cannot be flown.
    """
    if angles.size < 2:
        raise ValueError(f"a fly scan needs at least 2 views, the plan has {angles.size}; use scan.mode: step")
    scale = Scale.of(to_counts)
    index, step = _lattice(angles, abs(scale.per_count))
    exact = step / abs(scale.per_count)
    whole = round(exact)
    if whole < 1:
        raise ValueError(
            f"views {math.degrees(step):.3g}° apart are {exact:.3g} counts of the stage "
            f"({math.degrees(abs(scale.per_count)):.3g}° each); take fewer views or a stage with finer counts"
        )
    direction = 1 if scale.per_count > 0 else -1
    first = to_counts(float(angles[0])) - direction * whole * int(index[0])
    counts = first + direction * whole * index
    runs = _runs(counts)
    spacing = {abs(train.interval) for train in runs}
    if len(spacing) > 1 or min(train.n for train in runs) < 2:
        raise ValueError(
            "the views do not come in passes of equal steps, so a turning stage cannot trigger them in this order. "
            "Use scan.mode: step, or a fixed, sector or interlaced plan"
        )
    drift = float(np.abs(scale.angles(counts) - angles).max())
    return Flight(tuple(runs), spacing.pop(), whole, exact, drift)


def _lattice(angles: NDArray[np.float64], count: float) -> tuple[NDArray[np.int64], float]:
    """Index of each angle on the lattice from the smallest to the largest, and the lattice's step in radians."""
    low, high = float(angles.min()), float(angles.max())
    step = (high - low) / (angles.size - 1)
    if step > 0:
        index = np.rint((angles - low) / step).astype(np.int64)
        off = float(np.abs(low + index * step - angles).max())
        # Half a count is lost to rounding anyway; a text file with few digits loses less than a hundredth of a step.
        if np.unique(index).size == angles.size and off <= max(count / 2, step / 100):
            return index, step
    raise ValueError(
        "the views are not equally spaced, so a turning stage cannot trigger them at a fixed distance; "
        "use scan.mode: step, or a fixed, sector or interlaced plan"
    )


def _runs(counts: NDArray[np.int64]) -> list[TriggerTrain]:
    """The longest runs of equal differences, one after another; a single count is a run of one."""
    runs: list[TriggerTrain] = []
    at = 0
    while at < counts.size:
        if at + 1 == counts.size:
            runs.append(TriggerTrain(int(counts[at]), 0, 1))
            break
        interval = int(counts[at + 1] - counts[at])
        end = at + 1
        while end + 1 < counts.size and counts[end + 1] - counts[end] == interval:
            end += 1
        runs.append(TriggerTrain(int(counts[at]), interval, end - at + 1))
        at = end + 1
    return runs
