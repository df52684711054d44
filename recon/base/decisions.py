"""Decisions: values that a method derives from its data, stored so that all slabs of a scan use the same ones."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self, TypeVar

T = TypeVar("T")


class MaterialPrior(NamedTuple):
    """Discrete grey levels of the sample, and the strength with which voxels are pulled towards them (discrete
    tomography).

    Attributes:
        levels: densities of the materials, ascending. If the list is empty, voxels are not pulled.
        weights: shares of the materials in the sample.
        tv_share: weight of total variation if voxels are pulled, divided by the weight without a pull.
        pull: factor c of the step c (z - x) from the voxels x towards the levels z. The step that fits the projections
            has the factor 1.
        noise: standard deviation of the noise of a voxel, divided by the gap between levels. The smaller it is, the
            fewer voxels between two levels are pulled. Volumes by earlier versions used 0.2.
    """

    levels: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()
    tv_share: float = 1.0
    pull: float = 0.0
    noise: float = 0.2

    def scaled(self, power: int) -> MaterialPrior:
        """The same levels in units in which all densities are 2^power times as large."""
        return self._replace(levels=tuple(math.ldexp(level, power) for level in self.levels))


class Prior(NamedTuple):
    """The prior of a volume.

    Attributes:
        weight: of total variation, μ of min ½||A x - p||² + μ TV(x).
        strength: last threshold of the patch-based denoiser (PnP-DCT); 0: PnP-DCT was not tried.
        patches: PnP-DCT predicts held-out projections better than total variation alone.
        materials: discrete levels that voxels are pulled to; None: levels were not searched for.
        half_voxel_weight: weight of total variation on half voxels, divided by the weight on whole voxels. 0: no half
            voxels are used, because they predict held-out projections worse. None: half voxels were not tested.
    """

    weight: float
    strength: float = 0.0
    patches: bool = False
    materials: MaterialPrior | None = None
    half_voxel_weight: float | None = None

    @classmethod
    def of(cls, values: Sequence[Any]) -> Prior:
        """A prior, or its values from a file."""
        weight, strength, patches, materials, half_voxel_weight = values
        return cls(weight, strength, patches, materials and MaterialPrior(*materials), half_voxel_weight)


class IterationEnd(NamedTuple):
    """How the iterations of a volume ended.

    Attributes:
        how: "still": the volume converged; "stopped"; "bound": all iterations were made.
        after: number of iterations.
        change: share by which the last four iterations changed the volume; inf: not known.
        on_half_voxels: how many of the iterations used half voxels; None: none were planned.
    """

    how: str
    after: int
    change: float = math.inf
    on_half_voxels: int | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """The settings that say so in the record of the volume; what is not known is left out."""
        values = {"ended": self.how, "ended_after": self.after, "last_change": self.change}
        known = {name: value for name, value in values.items() if value != math.inf}
        return known if self.on_half_voxels is None else {**known, "half_voxel_iterations": self.on_half_voxels}


class Decisions:
    """The decisions that a run derives from its data, by name, in the order in which they were made.

    A weight of total variation, a step length or a restart depends on sums over the whole volume. If each slab derived
    these values from its own data, the values would differ and the volume would show a seam. Therefore one slab
    decides, and the other slabs reuse its decisions: `Decisions(seed, first.made)`. If `made` does not contain a
    decision, it is made when a method asks for it.

    Attributes:
        made: the decisions so far, by name: plain numbers and lists of numbers.
        prior: the prior of the volume in the units of the scan, if it was chosen before; None: the method chooses it.
        ended: how the iterations ended; None: they end after a fixed number, or have not begun.
        settings: further values for the record of the volume, in addition to the settings of its method.
    """

    def __init__(self, seed: int = 0, followed: Mapping[str, Sequence[Any]] | None = None) -> None:
        self.seed = seed
        self.prior: Prior | None = None
        self.ended: IterationEnd | None = None
        self.settings: dict[str, Any] = {}
        self.made: dict[str, list[Any]] = {}
        self._followed = followed or {}

    @property
    def record(self) -> dict[str, Any]:
        """`ended` and `settings`, for the record of the volume."""
        return {**({} if self.ended is None else self.ended.settings), **self.settings}

    def __call__(self, name: str, decide: Callable[[], T]) -> T:
        """The next decision with this name: the stored one if there is one, otherwise the result of `decide`."""
        before, made = self._followed.get(name, ()), self.made.setdefault(name, [])
        made.append(before[len(made)] if len(made) < len(before) else decide())
        value: T = made[-1]
        return value


class Stop:
    """Tells a run whether to end early and keep the result reached so far. The run calls this object between steps.

    Args:
        asks: function that returns True to end the work. After it has returned True, it is not called again.
        deadline: time at which the work ends by itself, in s of the clock `now`; inf: there is no deadline.
        now: the clock.

    Attributes:
        stopped: True if `asks` has requested the end. A run that ends at its own deadline counts as not stopped,
            because this end was planned. In a request made with `by`, the deadline of the request it was made from
            counts as a requested end.
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
        """Whether at least `seconds` s remain before the deadline of this request."""
        return self.deadline == math.inf or self._now() + seconds <= self.deadline

    def cut(self, done: int, planned: int) -> bool:
        """Whether the run was stopped before all `planned` steps or iterations were done. `planned` is 0 if no number
        was planned."""
        return self.stopped and not 0 < planned <= done


def always(step: int, residual: float) -> bool:
    """Work that nobody ends."""
    return True


class GoesOn:
    """Whether the iterations of a volume go on, and those of its test reconstructions.

    Iterations call it with their number, from 1, and the weighted ||A x - p|| / ||p|| before their correction, so that
    the volume afterwards is better. (For CGLS and ASD-POCS it is the residual of the volume afterwards.) It calls `ask`
    with these two numbers until the answer is False.

    Args:
        ask: is told of each iteration; False ends them.
        trials: asked after each iteration of the test reconstructions that choose a weight on some rows. If it ends
            them, the iterations of the volume follow. None: nobody ends them.

    Attribute `going`: the last answer; True before the first one.
    """

    def __init__(self, ask: Callable[[int, float], bool] = always, trials: GoesOn | None = None) -> None:
        self._ask, self.going = ask, True
        self.trials: GoesOn = trials or (self if ask is always else GoesOn())

    def __call__(self, step: int = 0, residual: float = 0.0) -> bool:
        self.going = self.going and self._ask(step, residual)
        return self.going

    def after(self, done: int, each: int = 1) -> GoesOn:
        """The same, for iterations that follow `done` others and take the time of `each` of them."""
        return GoesOn(lambda step, residual: self(done + each * step, residual), self.trials)
