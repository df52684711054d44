"""Work: the operations that a reconstruction computes, counted as a machine's speed is measured.

A method says what it does in these terms (`costs`, beside its `memory`); `recon.machine_speed` measures how long each
operation takes; `seconds_of` multiplies the two. Nothing else predicts a time.

The time of every operation is a line, first x a + second x b. What the two amounts are says the operation's line in
`recon.machine_speed.OPERATIONS`; on voxels they are lines along z and voxels, since kernels run along z.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

from recon.base.geometry import Geometry
from recon.base.method import for_part
from recon.base.volume import Grid

CLOCK = "clock"
"""The operation of a run that ends by a clock: its first amount is s."""


class Rate(NamedTuple):
    """Seconds that an operation takes for each unit of its two amounts."""

    first: float
    second: float


Rates = Callable[[str], Rate]
"""The rate of an operation on a machine, by its name; a caller may measure it when it is asked for."""


@dataclass(frozen=True)
class Work:
    """Amounts of operations, by their names. Works add, and multiply by numbers."""

    amounts: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, operation: str, first: float, second: float = 0.0) -> Work:
        return cls({operation: (first, second)})

    def __add__(self, other: Work) -> Work:
        total = dict(self.amounts)
        for name, (first, second) in other.amounts.items():
            before = total.get(name, (0.0, 0.0))
            total[name] = before[0] + first, before[1] + second
        return Work(total)

    def __mul__(self, factor: float) -> Work:
        return Work({name: (factor * first, factor * second) for name, (first, second) in self.amounts.items()})

    __rmul__ = __mul__

    def seconds(self, rates: Rates) -> float:
        """Seconds of this work on a machine with these rates."""
        total = 0.0
        for name, (first, second) in self.amounts.items():
            rate = Rate(1.0, 0.0) if name == CLOCK else rates(name)
            total += first * rate.first + second * rate.second
        return total


@dataclass(frozen=True)
class Costs:
    """The work of a reconstruction.

    Attributes:
        volumes: by the name of the method whose volume it may become. The data decide among them; `auto` and a fit
            have several.
        choice: before it, once for all slabs: trials that choose a method or the weight of a prior.
    """

    volumes: Mapping[str, Work]
    choice: Work = field(default_factory=Work)


class SizedRun(NamedTuple):
    """An operation of some size: the two amounts of its work, and what does it."""

    first: float
    second: float
    run: Callable[[], object]


class Span(NamedTuple):
    """Shortest and longest expected time of a run, in s.

    Attributes:
        least: where the data choose what takes least.
        most: where they choose what takes most.
    """

    least: float
    most: float


@runtime_checkable
class CostedMethod(Protocol):
    """A method that states its operations. The time of other methods is not known before they are tried."""

    def costs(self, geometry: Geometry, grid: Grid) -> Costs:
        """Its work on these views of a usual scan; what depends on the data, such as the trials of a weight, may
        differ."""


def parts_of(geometry: Geometry, heights: Sequence[int]) -> list[tuple[Geometry, Grid]]:
    """Views and voxels of each slab, where rows show slices; of other beams the one part with all."""
    grid = Grid.matching(geometry)
    if len(heights) == 1 and heights[0] == grid.shape[0]:
        return [(geometry, grid)]
    rows = geometry.detector_shape[0]
    views = (replace(geometry, detector_shape=(min(rows, height), geometry.detector_shape[1])) for height in heights)
    return [(some, replace(grid, shape=(height, *grid.shape[1:]))) for some, height in zip(views, heights, strict=True)]


def costs_of(method: Any, parts: Sequence[tuple[Geometry, Grid]], decided: bool = False) -> Costs | None:
    """The work of a volume that is made in parts, one after the other; None: the method does not state it.

    Args:
        parts: views and voxels of each slab.
        decided: the choices by the data were made before.

    Raises:
        ValueError: the method does not take the views.
    """
    if not isinstance(method, CostedMethod) or not parts:
        return None
    whole = sum(grid.shape[0] for _, grid in parts)
    each = []
    for geometry, grid in parts:
        share = grid.shape[0] / whole
        own = for_part(method, share, share) if share < 1 else method
        each.append(own.costs(geometry, grid))
    volumes = {name: sum((costs.volumes[name] for costs in each), Work()) for name in each[0].volumes}
    return Costs(volumes, Work() if decided else each[0].choice)


def seconds_of(costs: Costs, rates: Rates) -> Span:
    """Seconds of this work on a machine with these rates."""
    choice = costs.choice.seconds(rates)
    each = [choice + work.seconds(rates) for work in costs.volumes.values()]
    return Span(min(each), max(each))
