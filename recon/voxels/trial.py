"""Trial: makes test reconstructions from seven of every eight projections on some rows, to choose methods and priors.

A trial makes the volume of each candidate from the projections that are not held out. It measures the residual in each
held-out projection, and compares candidates by the rule of `recon.voxels.choice`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.decisions import Decisions, GoesOn, Prior
from recon.base.empirical import FIRST_THRESHOLD, ONE_IN, STILL_IN_TRIAL
from recon.base.geometry import Geometry
from recon.base.method import Clock, Method, ReconProblem, RunControl
from recon.base.registry import LibraryError
from recon.base.view_data import split_views
from recon.base.volume import Grid, Volume
from recon.voxels.choice import LEAST_GAIN, BestStrength, Prediction, TrialChoice, preferred_strength
from recon.voxels.field_edges import busiest_rows, columns_of_matter, middle_of_cone, slab_of
from recon.voxels.held_out import LEAST_VIEWS, TRIAL_ROWS, TRIAL_SWEEPS
from recon.voxels.ordered_fista import MANY_SUBSETS, SUBSETS, Pull, Subsets, ordered_fista, subsets_of
from recon.voxels.priors import TvWeight, noise_of_volume, pnp_dct, tv_prox
from recon.voxels.projector import volume_lines
from recon.voxels.residuals import unseen_residuals
from recon.voxels.standstill import MOST_SWEEPS
from recon.voxels.voxel_problem import VoxelProblem, times_power

# width of the field of view divided by that of a wide box, at most; fewest rows of a trial in such a box
_WIDE, _FEWEST_ROWS = 0.9, 4
TV_STEPS, EARLY_TV_STEPS = 12, 3
"""Dual steps of total variation in one step of an iteration: of `FistaTv` and its tests, and of the voxel refinement of
a fit and its tests.

With 3 steps, tests choose too small a weight if there are many columns: FISTA-TV of a cathode of 512 columns from 90
and 60 projections is 0.27 and 0.11 dB worse than with 12 steps in the tests. With 24 steps, nothing changes further.
"""
_LEVELS_PREDICT = "discrete levels predict the held-out projections better"
PATCH_STEPS = 35
"""Number of steps with sparse patches in a trial; also the default of `PnpDct`."""


def _share_in_field(geometry: Geometry, grid: Grid) -> float:
    """Width of the field of view divided by that of the box."""
    return 2 * geometry.reach / (grid.shape[2] * grid.voxel_size)


def _is_wide(problem: VoxelProblem) -> bool:
    """Whether the sample is wider than the field of view, or the box is wider than the field by a tenth.

    In these cases FBP is a poor first volume, because it does not contain the outside material, and later steps put
    this material into the field of view. For example, a disc three times as wide as the field of view had 1.16 to 1.32
    times its density after twenty iterations that started from FBP, and 0.97 to 0.98 times if they started from an
    iteration of OS-SIRT.
    """
    return problem.wide or _share_in_field(problem.projector.geometry, problem.projector.grid) <= _WIDE


def _trial_rows(geometry: Geometry, grid: Grid) -> int:
    """Number of rows of a trial: fewer in a box that is wider than the field, so that it does not take longer."""
    share = _share_in_field(geometry, grid)
    return TRIAL_ROWS if share > _WIDE else max(_FEWEST_ROWS, round(TRIAL_ROWS * share))


def choose_weight(
    problem: VoxelProblem, start: F32 | None, sweeps: int, trial: Callable[[], Trial | None] | None = None
) -> TvWeight:
    """The weight μ of min ½||A x - p||² + μ TV(x), x >= 0, from held-out projections if there are any, or from the
    noise.

    μ divided by the number of projections follows the noise of a volume, which falls with the root of this number. So μ
    is √(8/7) times that of the trial. The search starts from the first volume of the trial and not from a fit, because
    a fit has used the held-out projections, and any weight would then raise their residual.

    Args:
        start, sweeps: as for `TvWeight.of_noise`.
        trial: function that returns the trial of this problem; None: `Trial.of`.
    """

    def chosen() -> list[float]:
        if problem.prior is not None:
            return [problem.prior.weight]
        balance = TvWeight.of_noise(problem, start, sweeps)
        judge = (trial() if trial else Trial.of(problem)) if balance.first > 0 else None
        best = None if judge is None else judge.best_weight(balance.first)
        return [balance.first, balance.noise or 0.0] if best is None else [best.strength]

    first, *noise = problem.decide("weight", chosen)
    return TvWeight(first, noise[0], sweeps) if noise else TvWeight(first)


class Patches(NamedTuple):
    """The settings of sparse patches that held-out projections chose.

    Attributes:
        strength: the strength of `pnp_dct`.
        better: True if patches predict these projections better than total variation alone.
    """

    strength: float
    better: bool


def choose_patches(problem: VoxelProblem, weight: TvWeight, trial: Callable[[], Trial | None], steps: int) -> Patches:
    """The strength of `pnp_dct` chosen by held-out projections, starting from volumes of total variation with a weight
    μ.

    A trial makes as many steps as the volume will. Each step adds noise, so with fewer steps a weaker prior would win.
    The search begins at the noise that a volume from all projections has without a prior. If no projections can be held
    out, this noise is the strength, and total variation alone counts as equally good. The densest material does not
    affect the noise or the strength, so weak material next to metal keeps its detail.
    """

    def chosen() -> list[float]:
        if problem.prior is not None:
            return [problem.prior.strength, problem.prior.patches]
        judge = None if weight.by_noise else trial()
        first = FIRST_THRESHOLD * noise_of_volume(problem if judge is None else judge.problem)
        if judge is None or first == 0:
            return [first, 0]
        best = judge.best_patches(weight.value, first, steps)
        if best is None:
            return [first, 0]
        return [best.strength, bool(best.residuals.mean() < judge.residuals_of_weight(weight.value).mean())]

    strength, better = problem.decide("strength", chosen)
    return Patches(strength, bool(better))


@dataclass(frozen=True)
class TrialSettings:
    """Settings of the run to which a trial belongs.

    Attributes:
        all_rows: description of the rows if the trial uses all rows (a cone beam whose middle rows show little
            material). Its pixels may be binned; then its priors are not valid for the volume. Empty: the trial uses
            some rows.
        now: the clock.
        early: True: iterations as in a voxel refinement, which begins with a fit and ends early; False: until volumes
            have converged.
    """

    all_rows: str = ""
    now: Clock = time.perf_counter
    early: bool = False


_USUAL_SETTINGS = TrialSettings()


@runtime_checkable
class Predicting(Protocol):
    """A method that can determine with a part of its work how well its volume predicts held-out projections."""

    def predict(self, trial: Trial, so_far: TrialChoice) -> Prediction:
        """The prediction of the method's volume. `so_far` contains the predictions of simpler candidates."""


def _with_rows(problem: VoxelProblem, rows: slice) -> VoxelProblem:
    """The problem with only these rows, which show slices."""
    views, box = slab_of(problem.projector.geometry, problem.projector.grid, rows.start, rows.stop)
    part, all_columns = problem.part(views, box, slice(None), slice(None), rows), problem.with_all_columns
    return part if all_columns is None else replace(part, with_all_columns=lambda: _with_rows(all_columns(), rows))


class AllColumns(NamedTuple):
    """The rows of a trial with all columns, including air, because a fit of narrower projections is worse.

    Attributes:
        cols: the columns of the trial.
        seen: function that makes the problem of the projections that are not held out.
        unseen: geometry of the held-out projections.
    """

    cols: slice
    seen: Callable[[], VoxelProblem]
    unseen: Geometry


class Trial:
    """Volumes of a slab, made from seven of every eight projections and judged by how well they predict the others.

    Attributes:
        problem: the problem of the slab.
        scan: the problem of all rows.
        start: [y, x, z], the first volume: FBP, or zeros if no direct method can use the projections; if `wide`, an
            iteration of OS-SIRT.
        unseen: the held-out projections.
        all_columns: the same rows with all columns.
        above: number of rows from the middle of all rows to the middle of the trial's rows. It is 0 for a cone beam,
            because its rows keep their heights.
        smooth: the volume of total variation that predicts the held-out projections best so far.
        settings: settings of the run to which the trial belongs.
    """

    def __init__(
        self, scan: VoxelProblem, slab: VoxelProblem, start: F32, unseen: VoxelProblem, all_columns: AllColumns,
        settings: TrialSettings, above: float = 0.0,
    ) -> None:  # fmt: skip
        self.above = above
        self._going = scan.go_on.trials
        self.scan, self.problem, self.start = scan, replace(slab, go_on=self._going), start
        self.unseen, self.all_columns, self.settings = unseen, all_columns, settings
        early, geometry = settings.early, scan.projector.geometry
        count = subsets_of(geometry, MANY_SUBSETS if early else SUBSETS, to_the_end=not early)
        self._subsets = Subsets.of(slab, count, to_the_end=not early)
        self._least = math.inf
        self._known: dict[tuple[str, float], F64] = {}
        self.smooth: F32 | None = None

    @classmethod
    def of(cls, problem: VoxelProblem, settings: TrialSettings = _USUAL_SETTINGS) -> Trial | None:
        """The trial of the rows with the most material; for a cone beam, of the rows in the middle.

        Columns of air far from the sample are left out.

        None if there are fewer than 16 projections, `middle_of_cone` returns None for a cone, the held-out projections
        have weight 0 in these rows, or `problem.go_on.trials` ends the trial.
        """
        geometry, grid = problem.projector.geometry, problem.projector.grid
        if geometry.n_views < LEAST_VIEWS or not problem.go_on.trials():
            return None
        images = problem.data.swapaxes(1, 2)
        if not geometry.is_cone:
            rows = busiest_rows(images, _trial_rows(geometry, grid))
            views, box = slab_of(geometry, grid, rows.start, rows.stop)
            return cls._of_rows(problem, settings, rows, views, box, columns_of_matter(views, box, images[:, rows]))
        height = _trial_rows(geometry, grid)
        if settings.all_rows or geometry.detector_shape[0] <= height:
            return cls._of_rows(problem, settings, slice(0, geometry.detector_shape[0]), geometry, grid)
        middle = middle_of_cone(geometry, grid, images, height)
        return None if middle is None else cls._of_rows(problem, settings, *middle)

    @classmethod
    def _of_rows(
        cls, problem: VoxelProblem, settings: TrialSettings, rows: slice, views: Geometry, box: Grid,
        matter: tuple[slice, Geometry, Grid] | None = None,
    ) -> Trial | None:  # fmt: skip
        def of_views(chosen: NDArray[np.intp], cols: slice, views: Geometry, box: Grid) -> VoxelProblem:
            return replace(
                problem.part(views.select(chosen), box, chosen, cols, rows),
                rng=np.random.default_rng(0),
                go_on=GoesOn(trials=problem.go_on.trials),
                decide=Decisions(),
            )

        cols, narrow, narrow_box = matter or (slice(None), views, box)
        seen, unseen = (of_views(view_numbers, cols, narrow, narrow_box) for view_numbers in split_views(views))
        if unseen.weight is not None and not unseen.weight.any(axis=(1, 2)).any():
            return None
        wide = _is_wide(problem)
        first = None if wide else seen.filtered("hann")
        if first is None:  # no direct method can use these projections
            depth, height, width = narrow_box.shape
            first = np.zeros((height, width, depth), np.float32)
        if wide:
            seen.first_sweep(first, seen.rng)
        others, judges = split_views(views)
        all_columns = AllColumns(cols, partial(of_views, others, slice(None), views, box), views.select(judges))
        part = replace(seen, with_all_columns=all_columns.seen if matter else None)
        whole = problem.projector.geometry
        above = 0.0 if whole.is_cone else (rows.start + rows.stop - whole.detector_shape[0]) / 2
        return cls(problem, part, np.maximum(first, 0, out=first), unseen, all_columns, settings, above)

    def in_the_middle(self, count: int) -> tuple[Trial, slice]:
        """The same trial with only the `count` rows in the middle, and these rows; all rows if they do not show slices.

        Tests of volumes that exist already take less time with fewer rows.
        """
        geometry = self.problem.projector.geometry
        n = geometry.detector_shape[0]
        if n <= count or not geometry.rows_show_slices:
            return self, slice(None)
        rows = slice((n - count) // 2, (n - count) // 2 + count)
        part = copy(self)
        part.problem, part.unseen = _with_rows(self.problem, rows), _with_rows(self.unseen, rows)
        return part, rows

    @property
    def ended(self) -> bool:
        """True if the trials were stopped. No further volume is then judged."""
        return not self._going.going

    def residuals_of(self, prior: str, strength: float, volume: Callable[[float], F32]) -> F64:
        """Residuals for this prior and strength; each volume is made only once."""
        if (prior, strength) not in self._known:
            x = volume(strength)
            residuals = self._known[prior, strength] = self.residuals(x)
            if prior == "weight" and residuals.mean() < self._least:
                self.smooth, self._least = x, float(residuals.mean())
        return self._known[prior, strength]

    def best_weight(self, first: float) -> BestStrength | None:
        """The weight μ of total variation for all projections, searched from `first`; None: the trials were stopped."""
        best = preferred_strength(self.residuals_of_weight, first)
        if best is None:
            return None
        of_all = replace(best, strength=best.strength * math.sqrt(ONE_IN / (ONE_IN - 1)))
        self._known["weight", of_all.strength] = best.residuals
        return of_all

    def best_patches(self, weight: float, first: float, steps: int) -> BestStrength | None:
        """The strength of `steps` steps with patches after total variation, searched from `first`.

        None: the trials were stopped.
        """
        smooth = self.volume_of_weight(weight) if self.smooth is None else self.smooth

        def volume_of(strength: float) -> F32:
            return self.volume_by(lambda part, first: pnp_dct(part, first, strength, steps=steps), smooth)

        best = preferred_strength(lambda strength: self.residuals_of("patches", strength, volume_of), first)
        if best is not None:
            self._known["patches", best.strength] = best.residuals
        return best

    @cached_property
    def weight(self) -> float | None:
        """The weight of total variation for all projections, in the units of the problem; None: the noise decides."""
        weight = choose_weight(self.scan, None, 0, lambda: self)
        return None if weight.by_noise else weight.value

    @property
    def smooth_residuals(self) -> F64:
        """Residuals for total variation with the chosen weight.

        Raises:
            ValueError: no weight was chosen.
        """
        if self.weight is None:
            raise ValueError("no weight of total variation could be chosen")
        return self.residuals_of_weight(self.weight)

    @cached_property
    def early_weight(self) -> float | None:
        """The weight of total variation for a voxel refinement; it is larger, because the refinement ends early.

        None under the same conditions as for `weight`.
        """
        early = Trial.of(self.scan, replace(self.settings, early=True))
        return None if early is None else early.weight

    @property
    def wide(self) -> bool:
        """Whether the sample is wider than the field of view, or the box is wider than the field by a tenth.

        In these cases patches are not tried. All projections contain outside material, so patches have a lower residual
        in the held-out projections although total variation is closer to the ground truth (by 0.4 and 0.6 dB for two
        samples).
        """
        return _is_wide(self.scan)

    @cached_property
    def prior(self) -> Prior | None:
        """The weight for all projections, and patches after it unless the sample is `wide`; None: as for `weight`."""
        if self.weight is None:
            return None
        if self.wide:
            return Prior(self.weight)
        return Prior(self.weight, *choose_patches(self.scan, TvWeight(self.weight), lambda: self, PATCH_STEPS))

    def compare(self, candidates: Sequence[Method], least_gain: float = LEAST_GAIN) -> TrialChoice:
        """Which candidate predicts the held-out projections best; a candidate that cannot use the projections is not
        tried.

        A candidate is run unchanged on the projections that are not held out. If it has a method `predict`, this method
        finds its residuals with a part of the work. If discrete levels already predict these projections better (see
        `TrialChoice.levels_suffice`), further candidates are not run, unless the best one is requested (`least_gain`
        0).

        Args:
            candidates: the candidates, the simplest and cheapest first.
        """
        rows = self.unseen.projector.geometry.detector_shape[0]
        choice = TrialChoice(self.settings.all_rows or f"{rows} rows", least_gain)
        for each in candidates:
            try:
                prediction = (
                    Prediction(each.name, remark=f"{each.name} not tried, because {_LEVELS_PREDICT}")
                    if least_gain > 0 and choice.levels_suffice(costs_little=each.costs_little)
                    else each.predict(self, choice) if isinstance(each, Predicting) else self.predicted(each)
                )  # fmt: skip
            except (ValueError, LibraryError) as error:
                prediction = Prediction(each.name, remark=f"{each.name}: {error}")
            choice = choice.after(prediction)
        return choice

    def predicted(self, method: Method) -> Prediction:
        """The prediction of a method's own volume, made from the projections that are not held out."""
        views = self.views_of(method)
        result = method.run(views, self.control)
        return self.prediction(method.name, self.residuals(self.lines_of(result.volume)))

    def prediction(self, name: str, residuals: F64 | None, prior: Prior | None = None, remark: str = "") -> Prediction:
        """A prediction in the units of the scan; `prior` is in the units of the problem."""
        weighed = self.problem.weight is not None
        of_scan = None if prior is None or self.settings.all_rows else self.problem.units.prior(prior, weighed, 1)
        values = None if residuals is None else self.in_line_integrals(residuals).tolist()
        return Prediction(name, values, of_scan, remark)

    def in_line_integrals(self, residuals: F64) -> F64:
        """Residuals in the units of the scan, including the root of the weights."""
        units, weighed = self.problem.units, self.problem.weight is not None
        return np.asarray(residuals * 2.0 ** (units.integral + weighed * units.weight / 2))

    @property
    def control(self) -> RunControl:
        """The control for a run that is one of the trials."""
        return RunControl(lambda: not self._going(), now=self.settings.now)

    def views_of(self, method: Method) -> ReconProblem:
        """The projections that are not held out, as methods get them: with all columns, in the units of the scan."""
        problem = self.all_columns.seen().of_scan
        return replace(problem, device=method.device_of(problem))

    def lines_of(self, volume: Volume) -> F32:
        """A volume made from `views_of`, converted to one of the trial, [y, x, z]."""
        shape = self.problem.projector.grid.shape
        y, x = ((n_given - n_wanted) // 2 for n_given, n_wanted in zip(volume.data.shape[1:], shape[1:], strict=True))
        part = np.maximum(volume.data[:, y : y + shape[1], x : x + shape[2]], 0)
        return times_power(volume_lines(part), -self.problem.units.density)

    def residuals_of_weight(self, weight: float) -> F64:
        """Residuals for total variation with this weight. `smooth` becomes the best volume of all weights."""
        return self.residuals_of("weight", weight, self.volume_of_weight)

    def residuals_of_patches(self, strength: float) -> F64 | None:
        """Residuals for patches with this strength; None: the strength was not tried."""
        return self._known.get(("patches", strength))

    def volume_of_weight(
        self, weight: float, start: F32 | None = None, sweeps: int | None = None, pull: Pull | None = None
    ) -> F32:
        """The volume of total variation with this weight; `start` as for `volume_by`, `pull` as for `ordered_fista`.

        Args:
            sweeps: largest number; None: until the volume has converged, or as for a voxel refinement.
        """
        most_sweeps = sweeps or (TRIAL_SWEEPS if self.settings.early else MOST_SWEEPS)
        steps = EARLY_TV_STEPS if self.settings.early else TV_STEPS
        return self.volume_by(lambda part, x: ordered_fista(
            part, x, TvWeight(weight), self._subsets, sweeps=most_sweeps, prox=tv_prox(part, steps), pull=pull,
            still=STILL_IN_TRIAL,
        ), start)  # fmt: skip

    def volume_by(self, make: Callable[[VoxelProblem, F32], F32], start: F32 | None = None) -> F32:
        """The volume that `make` computes from a copy of the first volume; after the trials were stopped, this copy."""
        x = (self.start if start is None else start).copy()
        if self.ended:
            return x
        return make(replace(self.problem, rng=np.random.default_rng(0)), x)  # all volumes use the same order of subsets

    def residuals(self, x: F32, beyond: F32 | None = None) -> F64:
        """`unseen_residuals` of a volume [y, x, z]; infinite if the trials were stopped.

        Args:
            beyond: [held-out view, col, row], the part that its model adds to its projection.
        """
        unseen = self.unseen
        if self.ended:
            return np.full(len(unseen.data), np.inf)
        views = unseen.views if beyond is None else unseen.views - beyond
        return unseen_residuals(unseen.projector.forward_lines(x), views, unseen.weight, unseen.projector.resolution)
