"""MLEM and OSEM: the volume of highest Poisson likelihood, of what was counted or of line integrals."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

import numpy as np

from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import Progress, ReconProblem, Reconstruction, RunControl, Traits
from recon.base.settings_check import check_settings
from recon.base.volume import Grid
from recon.base.work import Costs, Work
from recon.features.emission.likelihood import mlem, passes_by_halves
from recon.prep.emission import Emission
from recon.voxels.voxel_problem import iterative_memory
from recon.voxels.work import on_volume, sweep

UPDATES = 200
"""Of the volume, by all subsets: where counts do not say how many, and the most that they may ask for."""

_FLOOR = 1e-6  # of the mean line integral


@dataclass(frozen=True)
class Mlem:
    """See `likelihood.mlem`; one iteration after the other raises the likelihood. No voxel is below 0.

    Line integrals that come without counts are taken for counts with their weights as survival.

    Attributes:
        iterations: passes over all views; None: as counts held out prefer, see `passes_by_halves`, or 200 updates of
            the volume, where these are no counts.
    """

    name: ClassVar[str] = "mlem"
    label: ClassVar[str] = "MLEM"
    traits: ClassVar[Traits] = Traits(own_length=True)

    iterations: int | None = None

    def __post_init__(self) -> None:
        check_settings(self, whole={"iterations": 1})

    @property
    def most_iterations(self) -> int:
        """As many as counts held out may ask for."""
        return UPDATES

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return _run(self, problem, control, 1)

    def toy(self) -> Self:
        return replace(self, iterations=1)

    def costs(self, geometry: Geometry, grid: Grid) -> Costs:
        return Costs({self.name: _work(self, geometry, grid, 1)})

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return _memory(geometry, grid, weighted, 1)


@dataclass(frozen=True)
class Osem:
    """`Mlem` by subsets of the views, about as many times faster; without the promise of a likelihood that rises."""

    name: ClassVar[str] = "osem"
    label: ClassVar[str] = "OSEM"
    traits: ClassVar[Traits] = Traits(own_length=True)

    iterations: int | None = None
    subsets: int = 4

    def __post_init__(self) -> None:
        check_settings(self, whole={"iterations": 1, "subsets": 1})

    @property
    def most_iterations(self) -> int:
        """As many as counts held out may ask for."""
        return max(1, UPDATES // self.subsets)

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return _run(self, problem, control, min(self.subsets, problem.geometry.n_views))

    def toy(self) -> Self:
        return replace(self, iterations=1)

    def costs(self, geometry: Geometry, grid: Grid) -> Costs:
        return Costs({self.name: _work(self, geometry, grid, min(self.subsets, geometry.n_views))})

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return _memory(geometry, grid, weighted, min(self.subsets, geometry.n_views))


def _run(method: Mlem | Osem, problem: ReconProblem, control: RunControl, subsets: int) -> Reconstruction:
    begin, views = control.now(), problem.geometry.n_views
    history: list[Progress] = []

    def go_on(progress: Progress) -> bool:
        if control.on_progress is not None:
            control.on_progress(progress)
        return not control.stop()

    def tried(done: int) -> bool:
        seconds = control.now() - begin
        return go_on(Progress(done, 0, seconds, math.nan, math.nan, 0, views, unit="iterations tried on half"))

    def report(iteration: int, likelihood: float, residual: float) -> bool:
        seconds = control.now() - begin
        history.append(Progress(iteration, iterations, seconds, -likelihood, residual, 0, views))
        return not go_on(history[-1])

    emission, most = _emission(problem), max(1, UPDATES // subsets)
    chosen = method.iterations
    if chosen is None and problem.use.emission is not None:
        rng = np.random.default_rng(problem.seed)
        chosen = passes_by_halves(emission, problem.grid, subsets, most, rng, tried)
    iterations = most if chosen is None else chosen
    volume = mlem(emission, problem.grid, iterations, subsets, report)
    settings = {f.name: getattr(method, f.name) for f in fields(method)}
    return Reconstruction(volume, settings | {"iterations": iterations}, tuple(history))


def _emission(problem: ReconProblem) -> Emission:
    """What was counted, less the lines that weigh nothing."""
    given, weights = problem.use.emission, problem.use.weights
    if given is None:
        lines, survival_of_lines = masked(problem.projections, weights)
        survival_of_lines = np.ones_like(lines) if survival_of_lines is None else survival_of_lines
        counts = np.maximum(lines, 0) * survival_of_lines
        # Rays of real views may miss the grid, and are not 0: a background explains them.
        floor = np.full_like(counts, max(_FLOOR * float(counts.mean()), float(np.finfo(np.float32).tiny)))
        return Emission(counts, problem.geometry, survival_of_lines, floor)
    if weights is None or weights.all():
        return replace(given, geometry=problem.geometry)
    survival = np.ones_like(given.counts) if given.survival is None else given.survival
    return Emission(given.counts * (weights > 0), problem.geometry, survival * (weights > 0), given.background)


def _memory(geometry: Geometry, grid: Grid, weighted: bool, subsets: int) -> int:
    return iterative_memory(geometry, grid, 4.5 + subsets, 5.2 + 4 / subsets, 1.1 * weighted)


def _work(method: Mlem | Osem, geometry: Geometry, grid: Grid, subsets: int) -> Work:
    """At most: counts held out may ask for fewer iterations, after as many trials on halves of them."""
    iterations = method.most_iterations if method.iterations is None else method.iterations
    step = sweep(geometry, grid) + on_volume("pass", grid, 6 * subsets)
    return (iterations + 0.5) * step
