"""Iterative reconstruction on voxels: `solve` runs one of the methods in `recon.voxels.methods`.

    volume = solve(FistaTv(), Projector(geometry, grid), projections)

All methods compute in float32. TV weights are fractions of the density unit (the 99.5th percentile of the positive
voxels), so that they are valid for any unit of attenuation. Internally, lengths, line integrals and weights are scaled
to about one, because in other units sums of their squares could exceed the range of float32.
"""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, Protocol, Self

import numpy as np
from numba import get_num_threads, set_num_threads

from recon.base.arrays import F32
from recon.base.decisions import Decisions, GoesOn
from recon.base.geometry import Geometry, require_views
from recon.base.method import SWEEPS_OF_TRIALS, Progress, ReconProblem, Reconstruction, RunControl
from recon.base.method_kinds import Iterative
from recon.base.setting import Count
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.voxels.choice import MOST_TRIALS
from recon.voxels.projector import Projector, projection_lines, volume_lines, volume_slices
from recon.voxels.resolution import smoothed
from recon.voxels.voxel_problem import Buffers, Units, VoxelProblem, bytes_of, times_power

UNITS = "units"  # name of the decision about the units
TV_WEIGHT_CHOSEN = "tv_weight_chosen"
"""Name of the weight of total variation that a method chose, as a value of its setting `tv_weight`."""
_VOXELS_PER_THREAD = 2**16  # fewest voxels per thread in a single slice; with fewer, threads mostly wait for each other


class Iterating(Protocol):
    """Something that `solve` can run: a `VoxelMethod` or a part of one."""

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        """The volume [y, x, z] after the iterations, from `x`, which is overwritten."""


def watched(
    control: RunControl, n_views: int, usual_trials: int = 0, report: Callable[[int, float], object] = lambda *_: None
) -> GoesOn:
    """Decides, from this control, whether iterations and test reconstructions continue. `report` gets the progress of
    the iterations.

    Args:
        usual_trials: usual number of iterations of all test reconstructions, for the progress.
    """
    begin, count = control.now(), itertools.count(1)
    most_trials = round(MOST_TRIALS * usual_trials)

    def trial(*_: object) -> bool:
        if control.stop_of_trials():
            return False
        done = next(count)
        total, words = (usual_trials, "as a rule") if done <= usual_trials else (max(done, most_trials), "at most")
        control.report_progress(done, total, begin, n_views, f"{SWEEPS_OF_TRIALS} {words}")
        return True

    def iteration(number: int, residual: float) -> bool:
        report(number, residual)
        return not control.stop()

    trials = GoesOn(trial)
    trials.trials = trials
    return GoesOn(iteration, trials)


def solve(
    method: Iterating,
    projector: Projector,
    projections: F32,
    *,
    weight: F32 | None = None,
    start: Volume | None = None,
    nonnegative: bool = True,
    go_on: GoesOn | None = None,
    decide: Decisions | None = None,
) -> Volume:
    """Reconstruct line integrals on the projector's grid.

    The docstring of each method states its memory, in float32 volumes of the grid and copies of the projections.

    Args:
        projections: [view, row, col], line integrals, finite where their weight is not 0.
        weight: weight of each ray, [view, row, col], 0 or more: 0 for invalid pixels, otherwise the inverse variance;
            only ratios of weights matter. None: 1 for all rays.
        start: the first volume; None: zero.
        nonnegative: True: voxels below zero are clipped in every step (CGLS: at the end).
        decide: stores decisions that follow from all data, and contains the seed of the order of projections and
            subsets.

    Raises:
        ValueError: shapes do not match, values are not finite, weights are negative or all zero, or all projections are
            zero.
    """
    views = Views(projections, projector.geometry, weight)
    return solve_views(method, projector, views, start=start, nonnegative=nonnegative, go_on=go_on, decide=decide)


def solve_views(
    method: Iterating,
    projector: Projector,
    views: Views,
    *,
    start: Volume | None = None,
    nonnegative: bool = True,
    go_on: GoesOn | None = None,
    decide: Decisions | None = None,
) -> Volume:
    """`solve` for projections in the projector's geometry, with their weights and the reach of the sample."""
    problem, lines = scaled_problem(projector, views, start, nonnegative, go_on or GoesOn(), decide or Decisions())
    with threads_for(projector.grid):
        solution = method.iterate(problem, lines)
    return Volume(volume_slices(times_power(solution, problem.units.density)), projector.grid)


@contextmanager
def threads_for(grid: Grid) -> Iterator[None]:
    """A context that limits the threads to those with enough work; a single slice needs only a few."""
    threads = get_num_threads()
    try:
        if grid.shape[0] == 1:
            set_num_threads(max(1, min(threads, math.prod(grid.shape) // _VOXELS_PER_THREAD)))
        yield
    finally:
        set_num_threads(threads)


def scaled_problem(
    projector: Projector,
    views: Views,
    start: Volume | None,
    nonnegative: bool,
    go_on: GoesOn,
    decide: Decisions,
) -> tuple[VoxelProblem, F32]:
    """The problem for these projections in units of about one, and its first volume [y, x, z]; see `solve_views`."""
    data, rays = _checked(projector, views.data, views.weights)
    lines = _start(projector, start)
    units = Units(*decide(UNITS, lambda: Units.of(projector, data, rays)))
    times_power(data, -units.integral)
    times_power(lines, -units.density)
    if rays is not None:
        times_power(rays, -units.weight)
    scaled_projector = units.projector(projector)
    at_voxels = smoothed(data, scaled_projector.resolution, None if rays is None else rays > 0)
    problem = VoxelProblem(
        scaled_projector, at_voxels, rays, nonnegative, np.random.default_rng(decide.seed), go_on, decide,
        measured=None if at_voxels is data else data, units=units, reach=views.reach,
    )  # fmt: skip
    return problem, lines


@dataclass(frozen=True)
class VoxelMethod(Iterative):
    """A method whose iterations improve a volume of voxels; a subclass adds its settings.

    Attributes:
        buffers: arrays in memory at the peak of a run.
        first_sweeps: iterations over the projections for the first volume; they are counted before the other
            iterations.
    """

    buffers: ClassVar[Buffers]
    first_sweeps: ClassVar[int] = 0
    iterations: Count

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return bytes_of(self.buffers, geometry, grid, weighted)

    @abstractmethod
    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        """See `Iterating`."""

    @property
    def usual_sweeps(self) -> int:
        """Usual number of iterations; fewer than `iterations` if the volume converges earlier."""
        return self.iterations

    def further_sweeps(self, geometry: Geometry, grid: Grid) -> int:
        """Usual time after `iterations`, as a number of iterations; 0 unless further iterations use smaller voxels."""
        return 0

    def refit(self, share: float) -> VoxelMethod:
        """The method of the refits for error bars: it continues from a finished volume and makes this share of the
        iterations.
        """
        return replace(self, iterations=max(1, round(share * self.iterations)))

    def toy(self) -> Self:
        return replace(self, iterations=1)

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """The volume with the history of its iterations.

        Raises:
            ValueError: as for `solve`.
        """
        begin, views = control.now(), problem.geometry.n_views
        further = self.further_sweeps(problem.geometry, problem.grid)
        history: list[Progress] = []

        def report(iteration: int, residual: float) -> None:
            seconds, planned = control.now() - begin, self.first_sweeps + self.iterations + further
            history.append(Progress(iteration, planned, seconds, residual, residual, 0, views))
            control.tell(history[-1])

        decide, settings = control.decide or Decisions(problem.seed), asdict(self)
        go_on = watched(control, views, self.trial_sweeps, report)
        projector = Projector(problem.geometry, problem.grid, device=problem.device)
        volume = solve_views(
            self, projector, problem.views.masked(), nonnegative=not self.allow_negative, go_on=go_on, decide=decide,
        )  # fmt: skip
        chosen = {name: decide.made[name][-1] for name in (TV_WEIGHT_CHOSEN,) if name in decide.made}
        return Reconstruction(volume, {**settings, **chosen, **decide.record, "seed": problem.seed}, tuple(history))


def _checked(projector: Projector, projections: F32, weight: F32 | None) -> tuple[F32, F32 | None]:
    """Data and weights in the order [view, col, row]. Values with weight 0 become 0."""
    require_views(projector.geometry, projections)
    finite = np.isfinite(projections)
    if weight is not None:
        require_views(projector.geometry, weight, "weights")
        if not (np.isfinite(weight).all() and weight.min() >= 0 and weight.max() > 0):
            raise ValueError("weights must be finite, 0 or more, and not all zero")
        finite |= weight == 0
    if not finite.all():
        raise ValueError(
            f"correct the projections, or give bad values weight 0: {int((~finite).sum())} of {finite.size} values "
            "are not finite"
        )
    data = projection_lines(projections)
    rays = None if weight is None else projection_lines(weight)
    if rays is not None:
        data[rays == 0] = 0
    if not data.any():
        raise ValueError("all projections are zero, so there is nothing to reconstruct")
    return data, rays


def _start(projector: Projector, start: Volume | None) -> F32:
    nz, ny, nx = projector.grid.shape
    if start is None:
        return np.zeros((ny, nx, nz), np.float32)
    if start.data.shape != projector.grid.shape or not np.isfinite(start.data).all():
        raise ValueError(
            f"the first volume must be finite and have shape {projector.grid.shape}, got {start.data.shape}"
        )
    return volume_lines(start.data)
