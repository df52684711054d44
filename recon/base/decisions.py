"""Decisions: what a method derives from its data, kept so that other slabs of the same scan use it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self, TypeVar

T = TypeVar("T")


class MaterialPrior(NamedTuple):
    """Few materials that voxels are pulled to, and how.

    Attributes:
        levels: densities of the materials, ascending; none: voxels are not pulled.
        weights: shares of the materials in the sample.
        tv_share: weight of total variation beside the pull, over that without one.
        pull: c of the step c (z - x), where a step of the views is one.
    """

    levels: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()
    tv_share: float = 1.0
    pull: float = 0.0

    def scaled(self, power: int) -> MaterialPrior:
        """The same in units in which densities are 2^power times as large."""
        return self._replace(levels=tuple(math.ldexp(level, power) for level in self.levels))


class Prior(NamedTuple):
    """The prior of a volume.

    Attributes:
        weight: of total variation, μ of min ½||A x - p||² + μ TV(x).
        strength: last threshold of sparse patches; 0: it was not sought.
        patches: these predict views held out better than total variation alone.
        materials: that voxels are pulled to; None: they were not sought.
    """

    weight: float
    strength: float = 0.0
    patches: bool = False
    materials: MaterialPrior | None = None

    @classmethod
    def of(cls, values: Sequence[Any]) -> Prior:
        """A prior, or its values from a file."""
        weight, strength, patches, materials = values
        return cls(weight, strength, patches, materials and MaterialPrior(*materials))


class Decisions:
    """The decisions that a run makes from its data, by name and in order.

    A weight of total variation, a step or a restart that follows from sums over a whole volume would differ from slab
    to slab, and show as a seam. So one slab decides, and the others follow: `Decisions(seed, first.made)`. Decisions
    that `made` does not hold are then made.

    Attributes:
        made: so far, by name; plain numbers and lists of them.
        prior: of the volume, in the units of the scan, where it was chosen before; None: the method decides.
        settings: what the volume's record says beside the settings of its method.
    """

    def __init__(self, seed: int = 0, followed: Mapping[str, Sequence[Any]] | None = None) -> None:
        self.seed = seed
        self.prior: Prior | None = None
        self.settings: dict[str, Any] = {}
        self.made: dict[str, list[Any]] = {}
        self._followed = followed or {}

    def __call__(self, name: str, decide: Callable[[], T]) -> T:
        """The next decision of this name: the earlier one if it was made, otherwise the result of `decide`."""
        before, made = self._followed.get(name, ()), self.made.setdefault(name, [])
        made.append(before[len(made)] if len(made) < len(before) else decide())
        value: T = made[-1]
        return value


class Stop:
    """A request to end a run with its result so far; the run asks it between steps.

    Args:
        asks: True ends the work, and it is not asked again.
        deadline: when the work ends by itself, by `now`, in s; inf: never.
        now: the clock.

    Attributes:
        stopped: somebody asked for the end; the deadline alone does not count, because it was planned. Of one
            made by `by` the deadline of the first counts as asked for.
    """

    def __init__(
        self,
        asks: Callable[[], bool] = lambda: False,
        deadline: float = math.inf,
        now: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._asks, self.deadline, self._now, self.stopped = asks, deadline, now, False

    def __call__(self) -> bool:
        if self.deadline < math.inf and self._now() >= self.deadline:
            return True
        self.stopped = self.stopped or bool(self._asks())
        return self.stopped

    def by(self, deadline: float, now: Callable[[], float]) -> Self:
        """The same request with a deadline."""
        return type(self)(self, deadline, now)

    def leaves(self, seconds: float) -> bool:
        """Whether at least `seconds` s remain before its own deadline."""
        return self.deadline == math.inf or self._now() + seconds <= self.deadline

    def cut(self, done: int, planned: int) -> bool:
        """Whether a stop left some of the `planned` steps or iterations undone; 0: no number is planned."""
        return self.stopped and not 0 < planned <= done


class GoesOn:
    """A `go_on` (step, residual) that keeps its last answer in `going`."""

    def __init__(self, go_on: Callable[[int, float], bool]) -> None:
        self._go_on, self.going = go_on, True

    def __call__(self, step: int, residual: float) -> bool:
        self.going = self._go_on(step, residual)
        return self.going
