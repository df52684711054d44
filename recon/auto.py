"""Auto: chooses the method that predicts held-out projections best, on a part of the scan."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from recon.base.choices import AUTO, Quality
from recon.base.decisions import Decisions, GoesOn
from recon.base.geometry import Geometry
from recon.base.method import Method, ReconProblem, Reconstruction, RunControl
from recon.base.registry import LibraryError
from recon.base.setting import NonNegative
from recon.base.volume import Grid
from recon.methods import CANDIDATES, by_name
from recon.voxels.choice import LEAST_GAIN, TrialChoice
from recon.voxels.half_voxels import HalfVoxels, with_halves
from recon.voxels.held_out import LEAST_VIEWS
from recon.voxels.iterative import VoxelMethod, scaled_problem, threads_for, watched
from recon.voxels.projector import Projector
from recon.voxels.trial import Trial, TrialSettings

_SMALLEST = 64  # detectors with fewer pixels along a side are not binned


@dataclass(frozen=True, eq=False)
class Auto(Method):
    """Chooses a reconstruction method: `Auto` tests the candidates on a part of the scan, and takes the simplest
    candidate whose volume predicts the held-out projections about as well as that of the best candidate.

    The tests use the sixteen rows with most material; in a cone beam, the sixteen rows in the middle. If the middle
    rows contain little material, the tests use all rows at half the resolution. The test reconstructions hold out every
    eighth projection. The tests need at least 16 projections; with fewer projections, `Auto` takes the last of its
    candidates. docs/choosing.md explains this way to choose a method.

    Attributes:
        candidates: the methods, the simplest and cheapest first.
        least_gain: smallest fraction by which a costlier method must lower the residual in the held-out projections, so
            that `Auto` takes it. For `PnpDct`, a quarter of `least_gain` suffices if the gain is certain.
    """

    name: ClassVar[str] = AUTO
    label: ClassVar[str] = "Automatic choice"
    takes: ClassVar[frozenset[str]] = frozenset({"device", "budget", "quality"})
    halo: ClassVar[int] = max(by_name(name).halo for name in CANDIDATES)
    needs_matter: ClassVar[bool] = True

    candidates: tuple[Method, ...] = field(default_factory=lambda: tuple(by_name(name)() for name in CANDIDATES))
    least_gain: NonNegative = LEAST_GAIN

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.candidates:
            raise ValueError("candidates must contain at least one method, got none")

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """Reconstruct with the method that `choose` returns. The result also contains the reason for the choice.

        Raises:
            ValueError: all projections are zero, or no candidate can use the projections.
        """
        decide = control.decide or Decisions(problem.seed)
        choice = TrialChoice.of(decide("method", lambda: self.choose(problem, control)))
        return self.run_chosen(choice, problem, replace(control, decide=decide))

    def run_chosen(self, choice: TrialChoice, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """Reconstruct with the method that `choose` has already chosen. `control.decide` must be given."""
        assert control.decide is not None
        control.decide.prior = choice.prior
        chosen, result = self._run_choice(choice, problem, control)
        settings = {**result.settings, "chosen_method": chosen.name, "chosen_because": choice.reason}
        return replace(result, settings=settings, method=chosen.name, chosen=choice.reason)

    def _run_choice(
        self, choice: TrialChoice, problem: ReconProblem, control: RunControl
    ) -> tuple[Method, Reconstruction]:
        """The chosen candidate and its result. If no candidate was chosen, the last candidate whose library can be
        loaded is used."""
        chosen = self.candidates[-1 if choice.chosen is None else choice.chosen]
        try:
            return chosen, chosen.run(replace(problem, device=chosen.device_of(problem)), control)
        except LibraryError as error:
            if choice.chosen is not None or len(self.candidates) == 1:
                raise
            warnings.warn(f"{chosen.name} is not tried: {error}", stacklevel=2)
            return replace(self, candidates=self.candidates[:-1])._run_choice(choice, problem, control)

    def choose(self, problem: ReconProblem, control: RunControl) -> TrialChoice:
        """Choose the simplest candidate that predicts the held-out projections about as well as the best one.

        Raises:
            ValueError: all projections are zero, or no candidate can use the projections.
        """
        return self.tried(problem, control)[0]

    def tried(self, problem: ReconProblem, control: RunControl) -> tuple[TrialChoice, Trial | None]:
        """The choice that `choose` returns, and the test reconstructions that led to it (None if there were none, or if
        the run was stopped).
        """
        data = problem.projections
        if not any(np.isfinite(view).any() and np.nan_to_num(view, posinf=0, neginf=0).any() for view in data):
            raise ValueError("all projections are zero, so there is nothing to reconstruct")
        if problem.geometry.n_views < LEAST_VIEWS:
            return TrialChoice(f"{problem.geometry.n_views} projections are too few to hold any out"), None
        trial = _trial(problem, "", control, self.candidates)
        if trial is None and problem.geometry.is_cone:
            trial = _trial(*_coarse(problem), control, self.candidates)
        if control.stop():
            return TrialChoice("stopped before the choice"), None
        if trial is None:
            return TrialChoice("the held-out projections have no valid rays in the rows with the most material"), None
        with threads_for(problem.grid):
            choice = trial.compare(self.candidates, self.least_gain)
        if trial.ended:
            return TrialChoice("stopped before the choice"), None
        if choice.chosen is None:
            raise ValueError("; ".join(each.remark for each in choice.predictions))
        return self._with_half_voxels(choice, problem, trial), trial

    def _with_half_voxels(self, choice: TrialChoice, problem: ReconProblem, trial: Trial) -> TrialChoice:
        """The choice, with the weight of half voxels if the chosen candidate would use them."""
        assert choice.chosen is not None
        chosen, prior = self.candidates[choice.chosen], choice.prior
        if prior is None or not isinstance(chosen, HalfVoxels) or not chosen.halves(problem.geometry, problem.grid):
            return choice
        units, weighed = trial.problem.units, trial.problem.weight is not None
        with threads_for(problem.grid):
            weight = chosen.half_voxel_weight_of(trial, units.prior(prior, weighed))
        return choice.with_prior(prior._replace(half_voxel_weight=weight))

    @property
    def alternatives(self) -> tuple[Method, ...]:
        return self.candidates

    def with_quality(self, quality: Quality, default_count: int) -> Self:
        """The automatic choice with a quality preset. The preset "preview" tries only the first two candidates. The
        preset "best" takes a costlier method even if it is only slightly better, runs each test of a Gaussian fit to
        its end, and uses voxels half as wide in the last iterations."""
        if quality == "standard":
            return self
        best = quality == "best"
        candidates = tuple(with_halves(each, best) for each in (self.candidates if best else self.candidates[:2]))
        return replace(self, candidates=candidates, least_gain=0.0 if best else self.least_gain)

    def toy(self) -> Self:
        return replace(self, candidates=tuple(method.toy() for method in self.candidates))

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return max(method.memory(geometry, grid, weighted) for method in self.candidates)


def _trial(problem: ReconProblem, all_rows: str, control: RunControl, candidates: tuple[Method, ...]) -> Trial | None:
    """The test reconstructions of a problem; None if no projections of the problem can be held out."""
    # In a slab, progress counts only slices.
    silent = replace(control, on_progress=control.on_progress if control.decide is None else None)
    sweeps = max(_sweeps(each) for each in candidates)
    go_on = GoesOn(trials=watched(silent, problem.geometry.n_views, sweeps).trials)
    projector, decide = Projector(problem.geometry, problem.grid, device=problem.device), Decisions(problem.seed)
    scan, _ = scaled_problem(projector, problem.views.masked(), None, True, go_on, decide)
    return Trial.of(scan, TrialSettings(all_rows, control.now))


def _sweeps(method: Method) -> int:
    """Number of iterations of the test reconstructions of a method; if a method has none, the number of iterations of
    its volume."""
    return method.trial_sweeps or (method.iterations if isinstance(method, VoxelMethod) else 0)


def _coarse(problem: ReconProblem) -> tuple[ReconProblem, str]:
    """The problem binned 2 x 2 (not binned if its detector is small), and a text that says whether it is binned."""
    if min(problem.geometry.detector_shape) < _SMALLEST:
        return problem, "all rows"
    views = replace(problem.views.masked(), weights=None).binned(2)
    return replace(problem, views=views, grid=Grid.matching(views.geometry)), "all rows, binned 2 x 2"


def method_named(name: str) -> Method:
    """The method of this name with its default settings; "auto": `Auto`.

    Raises:
        ValueError: the name is unknown.
    """
    return Auto() if name == AUTO else by_name(name)()
