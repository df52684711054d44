"""Trial: volumes made of seven in eight views on some rows, judged by the views held out, and priors chosen so.

A trial makes each candidate's volume from the views that are not held out, measures its residual of each one that is,
and compares candidates by the rule of `recon.voxels.choice`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.decisions import Decisions, Prior
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
from recon.voxels.priors import NoiseBalance, noise_of_volume, pnp_dct
from recon.voxels.projector import volume_lines
from recon.voxels.residuals import unseen_residuals
from recon.voxels.standstill import MOST_SWEEPS
from recon.voxels.voxel_problem import VoxelProblem, times_power

_WIDE, _FEWEST_ROWS = 0.9, 4  # share that the field has of a wide box, at most; rows of a trial in one
TV_STEPS = 3  # of a trial, and of the finish of a fit
_LEVELS_PREDICT = "discrete levels predict the held-out projections better"
PATCH_STEPS = 35
"""Steps with sparse patches of a trial, and by default of `PnpDct`."""


def _share_in_field(geometry: Geometry, grid: Grid) -> float:
    """Width of the field over that of the box."""
    return 2 * geometry.reach / (grid.shape[2] * grid.voxel_size)


def _is_wide(problem: VoxelProblem) -> bool:
    """Whether the sample goes on beyond the field, or the box is wider than that by a tenth.

    FBP is a poor first volume there: it leaves out the matter beside the field, and later steps put that into the
    field. A disc three times as wide as the field came out at 1.16 to 1.32 times its density after twenty sweeps, and
    at 0.97 to 0.98 from a sweep of OS-SIRT.
    """
    return problem.wide or _share_in_field(problem.projector.geometry, problem.projector.grid) <= _WIDE


def _trial_rows(geometry: Geometry, grid: Grid) -> int:
    """Rows of a trial: fewer in a box that is wider than the field, so that it takes no longer."""
    share = _share_in_field(geometry, grid)
    return TRIAL_ROWS if share > _WIDE else max(_FEWEST_ROWS, round(TRIAL_ROWS * share))


def choose_weight(
    problem: VoxelProblem, start: F32 | None, sweeps: int, trial: Callable[[], Trial | None] | None = None
) -> NoiseBalance | float:
    """The weight μ of min ½||A x - p||² + μ TV(x), x >= 0: by held-out views, if there are any, else by the noise.

    μ over the number of views follows the noise of a volume, which falls with the root of that number. So μ is √(8/7)
    times that of the trial. It is sought from the trial's first volume: a fit knows the views held out, and any weight
    takes it away from them.

    Args:
        start, sweeps: as of `NoiseBalance.of`.
        trial: gives that of this problem; None: `Trial.of`.
    """

    def chosen() -> list[float]:
        if problem.prior is not None:
            return [problem.prior.weight]
        balance = NoiseBalance.of(problem, start, sweeps)
        judge = (trial() if trial else Trial.of(problem)) if balance.first > 0 else None
        best = None if judge is None else judge.best_weight(balance.first)
        return [balance.first, balance.noise] if best is None else [best.strength]

    first, *noise = problem.decide("weight", chosen)
    return NoiseBalance(first, noise[0], sweeps) if noise else first


class Patches(NamedTuple):
    """The settings of sparse patches chosen by held-out views.

    Attributes:
        strength: of `pnp_dct`.
        better: patches predict these views better than total variation alone.
    """

    strength: float
    better: bool


def choose_patches(
    problem: VoxelProblem, weight: NoiseBalance | float, trial: Callable[[], Trial | None], steps: int
) -> Patches:
    """The strength of `pnp_dct` chosen by held-out views, from volumes of total variation with a weight μ.

    Trials take as many steps as the volume will: noise enters with each, so that few steps prefer a weaker prior.

    The search begins at the noise that a volume of all views has without a prior. That is also the strength where no
    views can be held out. There total variation is taken to predict as well. Neither knows of the densest matter: weak
    matter beside metal keeps its detail.
    """

    def chosen() -> list[float]:
        if problem.prior is not None:
            return [problem.prior.strength, problem.prior.patches]
        judge = None if isinstance(weight, NoiseBalance) else trial()
        first = FIRST_THRESHOLD * noise_of_volume(problem if judge is None else judge.problem)
        if judge is None or isinstance(weight, NoiseBalance) or first == 0:
            return [first, 0]
        best = judge.best_patches(weight, first, steps)
        if best is None:
            return [first, 0]
        return [best.strength, bool(best.residuals.mean() < judge.residuals_of_weight(weight).mean())]

    strength, better = problem.decide("strength", chosen)
    return Patches(strength, bool(better))


@dataclass(frozen=True)
class TrialSettings:
    """The run that a trial belongs to.

    Attributes:
        all_rows: words for the rows of a trial of all of them, as of a cone whose middle shows little matter. Pixels
            may be joined for it, so that its priors are not those of the volume. Empty: a trial of some rows.
        now: the clock.
        early: sweeps as of a finish, which begins with a fit and ends early; else until volumes stand still.
    """

    all_rows: str = ""
    now: Clock = time.perf_counter
    early: bool = False


_USUAL = TrialSettings()


@runtime_checkable
class Predicting(Protocol):
    """A method that tells by a part of its work how well its volume predicts views held out."""

    def predict(self, trial: Trial, so_far: TrialChoice) -> Prediction:
        """The prediction of its volume; `so_far` has those of simpler candidates."""


class AllColumns(NamedTuple):
    """The rows of a trial with all columns, including air: a fit of narrower views is poorer.

    Attributes:
        cols: those of the trial.
        seen: makes the problem of the views that are not held out.
        unseen: the geometry of those that are.
    """

    cols: slice
    seen: Callable[[], VoxelProblem]
    unseen: Geometry


class Trial:
    """Volumes of a slab, made of seven in eight views and judged by the others, which they should predict.

    Attributes:
        problem: of the slab.
        scan: the problem of all rows.
        start: [y, x, z], the first volume: FBP, or zeros where no direct method takes the views; if `wide`, a sweep.
        unseen: the views held out.
        all_columns: the same rows with all columns.
        smooth: the volume of total variation that predicts these best, of those made so far.
        settings: of the run that the trial belongs to.
    """

    def __init__(
        self, scan: VoxelProblem, slab: VoxelProblem, start: F32, unseen: VoxelProblem, all_columns: AllColumns,
        settings: TrialSettings,
    ) -> None:  # fmt: skip
        self.scan, self.problem, self.start = scan, replace(slab, go_on=self._go_on), start
        self.unseen, self.all_columns, self.settings = unseen, all_columns, settings
        early, geometry = settings.early, scan.projector.geometry
        count = subsets_of(geometry, MANY_SUBSETS if early else SUBSETS, to_the_end=not early)
        self._subsets = Subsets.of(slab, count, to_the_end=not early)
        self._ended, self._least = False, math.inf
        self._known: dict[tuple[str, float], F64] = {}
        self.smooth: F32 | None = None

    @classmethod
    def of(cls, problem: VoxelProblem, settings: TrialSettings = _USUAL) -> Trial | None:
        """The trial of the rows with most matter; for a cone beam of those in the middle.

        Columns of air far beside the sample are left out.

        None: fewer than 16 views, a cone for which `middle_of_cone` gives None, views held out that weigh nothing in
        these rows, or `problem.trial_goes_on` ends it.
        """
        geometry, grid = problem.projector.geometry, problem.projector.grid
        if geometry.n_views < LEAST_VIEWS or not problem.trial_goes_on():
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
            def cut(rays: F32) -> F32:
                return np.ascontiguousarray(rays[chosen][:, cols, rows])

            return replace(
                problem,
                projector=replace(problem.projector, geometry=views.select(chosen), grid=box),
                data=cut(problem.data),
                measured=None if problem.measured is None else cut(problem.measured),
                weight=None if problem.weight is None else cut(problem.weight),
                rng=np.random.default_rng(0),
                go_on=lambda *_: True,
                decide=Decisions(),
            )

        cols, narrow, narrow_box = matter or (slice(None), views, box)
        seen, unseen = (of_views(some, cols, narrow, narrow_box) for some in split_views(views))
        if unseen.weight is not None and not unseen.weight.any(axis=(1, 2)).any():
            return None
        wide = _is_wide(problem)
        first = None if wide else seen.filtered("hann")
        if first is None:  # no direct method takes these views
            depth, height, width = narrow_box.shape
            first = np.zeros((height, width, depth), np.float32)
        if wide:
            seen.first_sweep(first, seen.rng)
        others, judges = split_views(views)
        all_columns = AllColumns(cols, partial(of_views, others, slice(None), views, box), views.select(judges))
        part = replace(seen, with_all_columns=all_columns.seen if matter else None)
        return cls(problem, part, np.maximum(first, 0, out=first), unseen, all_columns, settings)

    def _go_on(self, sweep: int, residual: float) -> bool:
        self._ended = self._ended or not self.problem.trial_goes_on()
        return not self._ended

    @property
    def ended(self) -> bool:
        """Whether the trials were stopped; no further volume is assessed."""
        return self._ended

    def residuals_of(self, prior: str, strength: float, volume: Callable[[float], F32]) -> F64:
        """Residuals for this prior and strength; each volume is made once."""
        if (prior, strength) not in self._known:
            x = volume(strength)
            residuals = self._known[prior, strength] = self.residuals(x)
            if prior == "weight" and residuals.mean() < self._least:
                self.smooth, self._least = x, float(residuals.mean())
        return self._known[prior, strength]

    def best_weight(self, first: float) -> BestStrength | None:
        """The weight μ of total variation for all views, searched from `first`; None: the trials were ended."""
        best = preferred_strength(self.residuals_of_weight, first)
        if best is None:
            return None
        of_all = replace(best, strength=best.strength * math.sqrt(ONE_IN / (ONE_IN - 1)))
        self._known["weight", of_all.strength] = best.residuals
        return of_all

    def best_patches(self, weight: float, first: float, steps: int) -> BestStrength | None:
        """The strength of `steps` steps with patches after total variation, searched from `first`; None: as above."""
        smooth = self.volume_of_weight(weight) if self.smooth is None else self.smooth

        def made(strength: float) -> F32:
            return self.volume_by(lambda part, first: pnp_dct(part, first, strength, steps=steps), smooth)

        best = preferred_strength(lambda strength: self.residuals_of("patches", strength, made), first)
        if best is not None:
            self._known["patches", best.strength] = best.residuals
        return best

    @cached_property
    def weight(self) -> float | None:
        """The weight of total variation of all views, in the units of the problem; None: by the noise."""
        weight = choose_weight(self.scan, None, 0, lambda: self)
        return None if isinstance(weight, NoiseBalance) else weight

    @property
    def smooth_residuals(self) -> F64:
        """Residuals for total variation of the weight chosen.

        Raises:
            ValueError: none was chosen.
        """
        if self.weight is None:
            raise ValueError("no weight of total variation could be chosen")
        return self.residuals_of_weight(self.weight)

    @cached_property
    def early_weight(self) -> float | None:
        """The weight of total variation for a finish, which ends early: a heavier one. None: as of `weight`."""
        early = Trial.of(self.scan, replace(self.settings, early=True))
        return None if early is None else early.weight

    @property
    def wide(self) -> bool:
        """Whether the sample goes on beyond the field, or the box is wider than that by a tenth: patches are not tried.

        What lies beside the field is in all views. So patches leave less of those held out where total variation is
        closer to the truth, by 0.4 and 0.6 dB of two samples.
        """
        return _is_wide(self.scan)

    @cached_property
    def prior(self) -> Prior | None:
        """The weight of all views, and patches after it unless the sample is `wide`; None: as of `weight`."""
        if self.weight is None:
            return None
        if self.wide:
            return Prior(self.weight)
        return Prior(self.weight, *choose_patches(self.scan, self.weight, lambda: self, PATCH_STEPS))

    def compare(self, candidates: Sequence[Method], least_gain: float = LEAST_GAIN) -> TrialChoice:
        """Which candidate predicts the views held out; one that does not take them is not tried.

        A candidate is run as it is, on the views that are not held out, unless it has a method `predict`, which tells
        its residuals by a part of the work; after few materials that predict these views it is not run, unless the best
        is asked for.

        Args:
            candidates: the simplest and cheapest first.
        """
        rows = self.unseen.projector.geometry.detector_shape[0]
        choice = TrialChoice(self.settings.all_rows or f"{rows} rows", least_gain)
        for each in candidates:
            try:
                prediction = (
                    Prediction(each.name, remark=f"{each.name} not tried, because {_LEVELS_PREDICT}")
                    if least_gain > 0 and choice.few_materials
                    else each.predict(self, choice) if isinstance(each, Predicting) else self.predicted(each)
                )  # fmt: skip
            except (ValueError, LibraryError) as error:
                prediction = Prediction(each.name, remark=f"{each.name}: {error}")
            choice = choice.after(prediction)
        return choice

    def predicted(self, method: Method) -> Prediction:
        """The prediction of a method's own volume of the views that are not held out."""
        views = self.views_of(method)
        made = method.run(views, self.control)
        return self.prediction(method.name, self.residuals(self.lines_of(made.volume)))

    def prediction(self, name: str, residuals: F64 | None, prior: Prior | None = None, remark: str = "") -> Prediction:
        """A prediction in the units of the scan; `prior` in those of the problem."""
        weighed = self.problem.weight is not None
        of_scan = None if prior is None or self.settings.all_rows else self.problem.units.prior(prior, weighed, 1)
        left = None if residuals is None else self.in_line_integrals(residuals).tolist()
        return Prediction(name, left, of_scan, remark)

    def in_line_integrals(self, residuals: F64) -> F64:
        """Residuals in the units of the scan, the root of weights included."""
        units, weighed = self.problem.units, self.problem.weight is not None
        return np.asarray(residuals * 2.0 ** (units.integral + weighed * units.weight / 2))

    @property
    def control(self) -> RunControl:
        """The control of a run that counts as one of the trials."""
        return RunControl(lambda: not self._go_on(0, 0.0), now=self.settings.now)

    def views_of(self, method: Method) -> ReconProblem:
        """The views that are not held out as a method gets them, with all columns and in the units of the scan."""
        problem = self.all_columns.seen().of_scan
        return replace(problem, device=method.device_of(problem))

    def lines_of(self, volume: Volume) -> F32:
        """A volume made of `views_of` as one of the trial, [y, x, z]."""
        shape = self.problem.projector.grid.shape
        y, x = ((many - few) // 2 for many, few in zip(volume.data.shape[1:], shape[1:], strict=True))
        part = np.maximum(volume.data[:, y : y + shape[1], x : x + shape[2]], 0)
        return times_power(volume_lines(part), -self.problem.units.density)

    def residuals_of_weight(self, weight: float) -> F64:
        """Residuals for total variation of this weight; `smooth` is the best volume of all weights."""
        return self.residuals_of("weight", weight, self.volume_of_weight)

    def residuals_of_patches(self, strength: float) -> F64 | None:
        """Residuals for patches of this strength; None: it was not tried."""
        return self._known.get(("patches", strength))

    def volume_of_weight(
        self, weight: float, start: F32 | None = None, sweeps: int | None = None, pull: Pull | None = None
    ) -> F32:
        """The volume of total variation with this weight, `start` and `pull` as of `volume_by` and `ordered_fista`.

        Args:
            sweeps: at most; None: until the volume stands still, or as of a finish.
        """
        most = sweeps or (TRIAL_SWEEPS if self.settings.early else MOST_SWEEPS)
        return self.volume_by(lambda part, x: ordered_fista(
            part, x, weight, self._subsets, sweeps=most, tv_steps=TV_STEPS, pull=pull, still=STILL_IN_TRIAL
        ), start)  # fmt: skip

    def volume_by(self, make: Callable[[VoxelProblem, F32], F32], start: F32 | None = None) -> F32:
        """The volume that `make` computes from a copy of the first one; that copy once the trials ended."""
        x = (self.start if start is None else start).copy()
        if self._ended:
            return x
        return make(replace(self.problem, rng=np.random.default_rng(0)), x)  # the same order of subsets for all

    def residuals(self, x: F32, beyond: F32 | None = None) -> F64:
        """`unseen_residuals` of a volume [y, x, z]; infinite if the trials were stopped.

        Args:
            beyond: [view held out, col, row], what its model adds to its projection.
        """
        unseen = self.unseen
        if self._ended:
            return np.full(len(unseen.data), np.inf)
        views = unseen.views if beyond is None else unseen.views - beyond
        return unseen_residuals(unseen.projector.forward_lines(x), views, unseen.weight, unseen.projector.resolution)
