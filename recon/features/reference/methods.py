"""FromReference: reconstructs a state of a sample with the help of an earlier, careful scan of the same sample."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from recon.auto import Auto
from recon.base.arrays import F32
from recon.base.choices import Quality
from recon.base.decisions import Decisions, Prior
from recon.base.geometry import Geometry
from recon.base.method import Method, Preview, Progress, ReconProblem, Reconstruction, RunControl
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.features.reference.choice import MARGIN, ReferenceVerdict, about_reference, asked, if_it_overlaps, width_of
from recon.features.reference.fit import PLAN, StateFit
from recon.features.reference.motion import KNOTS, Basis, padded
from recon.features.reference.particles import bytes_placed, require_finite
from recon.features.reference.preview import preview_of
from recon.features.reference.weights import ALL_LINES, CLEAR_LINES
from recon.voxels.choice import TrialChoice
from recon.voxels.half_voxels import BY_QUALITY, COST, FEW, halved, uses_half_voxels
from recon.voxels.iterative import solve_views, watched
from recon.voxels.projector import Projector, volume_slices
from recon.voxels.trial import Trial
from recon.voxels.voxel_problem import Buffers, VoxelProblem, bytes_of, times_power

_FEW = 1.0
"""Number of projections below which the last iterations use half voxels, divided by the number of columns.

From 60 and 100 projections of 160 columns with 10⁴ photons, states change by -0.1 to +0.2 dB (mean +0.1), and what
changed in them by +0.1 to +0.5 dB (mean +0.2); cracks lose 0.01 of their depth. The time grows by a tenth.
"""
_ROUNDS = PLAN[2:]
# largest number of iterations of a round; rounds with falling weights, and iterations of each
_FIRST_ITERATIONS, _SHARPENING_ROUNDS, _LAST_ITERATIONS = 8, 2, 12
_START_BUFFERS = Buffers(8.0, 3.0, 3.5)  # when the reference is put on the voxels
# Peaks measured, in volumes: 54 in a slab of 16 rows, with 48 rows of the reference; 42 in 64 rows that all of the
# reference is in.
_BUFFERS, _PLACED = Buffers(40.0, 7.0, 3.5, filtered=True), 5
_HALF_VOXEL_BUFFERS = Buffers(20.0, 7.0, 3.5)  # in volumes of half voxels


@dataclass(frozen=True, eq=False)
class FromReference(Method):
    """Reconstructs a state of a sample from few projections and an earlier, careful volume of the same sample.

    The reference is moved to the state: by a rotation and a shift, then by an affine map, then by smooth splines, which
    are all found from the projections. Each particle of the reference gets a gain. The fit keeps two total variations
    small: that of the volume, and that of its difference from the moved reference; see `recon.features.reference.fit`.
    Held-out projections decide whether the reference is used. If it is not used, or if there are fewer than 16
    projections, the volume is exactly the volume of the method `otherwise`.

    Memory: the reference, 40 volumes (with half voxels 80), 7 times the projections, and 5 times the part of the
    reference that is used: up to 16 voxels beyond the volume on each side.

    Attributes:
        reference: the earlier volume, in 1/mm, in the coordinates of its own scan; None: there is no reference.
        otherwise: the method that is used if the reference is not.
        half_voxels: False: never; True: with any number of projections; None: see `uses_half_voxels`, with as many
            projections as columns as the limit. If held-out projections show that half voxels predict worse than whole
            voxels, they are not used.
    """

    name: ClassVar[str] = "from-reference"
    label: ClassVar[str] = "From a reference"
    takes: ClassVar[frozenset[str]] = frozenset({"device", "quality", "reference"})
    halo: ClassVar[int] = Auto.halo
    needs_matter: ClassVar[bool] = True

    reference: Volume | None = None
    otherwise: Auto = field(default_factory=Auto)
    half_voxels: bool | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reference is not None:
            require_finite(self.reference)

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """The volume with its change from the reference, or the volume of `otherwise`. The settings state which of the
        two it is, and why.

        Raises:
            ValueError: the reference and the volume have no place in common, or no method can use these projections.
        """
        decide, trials = control.decide or Decisions(problem.seed), list[Trial | None]()
        control = replace(control, decide=decide)

        def compared() -> TrialChoice:
            choice, trial = self.otherwise.tried(problem, control)
            trials.append(trial)
            return choice

        choice = TrialChoice.of(decide("method", compared))
        halves = uses_half_voxels(self.half_voxels, problem.geometry, problem.grid, _FEW)
        verdict = ReferenceVerdict.of(decide("reference", lambda: self._asked(choice, trials, halves)))
        if verdict.used and (of_reference := self._from_reference(verdict, problem, control)) is not None:
            return of_reference
        because = verdict.because
        if verdict.used:  # the decisions of slabs with the reference are not those of this method
            control = replace(control, decide=Decisions(problem.seed))
            because = "the reference shows no material in this part of the volume"
        result = self.otherwise.run_chosen(choice, problem, control)
        settings = {**result.settings, "reference_used": False, "reference_because": because}
        return replace(result, settings=settings, chosen=f"The reference was not used: {because}. {result.chosen}")

    def _asked(self, choice: TrialChoice, trials: list[Trial | None], halves: bool) -> ReferenceVerdict:
        trial = trials[0] if trials else None
        if trial is None or trial.settings.all_rows:
            return ReferenceVerdict(False, f"whether it helps cannot be tested ({choice.part_of_scan})")
        if self.reference is None:
            return ReferenceVerdict(False, "none was given")
        return asked(trial, choice, self.reference, halves)

    def _from_reference(
        self, verdict: ReferenceVerdict, problem: ReconProblem, control: RunControl
    ) -> Reconstruction | None:
        """The volume with the reference; None: this part of a volume is where the reference shows no material."""
        assert self.reference is not None and control.decide is not None
        begin, history = control.now(), list[Progress]()
        wanted = uses_half_voxels(self.half_voxels, problem.geometry, problem.grid, _FEW)
        halves = wanted and verdict.half_voxels
        planned = (1 + len(_ROUNDS)) * _FIRST_ITERATIONS + (_SHARPENING_ROUNDS + COST * halves) * _LAST_ITERATIONS

        def report(iteration: int, residual: float) -> None:
            seconds = control.now() - begin
            history.append(Progress(iteration, planned, seconds, residual, residual, 0, problem.geometry.n_views))
            control.tell(history[-1])

        state, decide = _State(self.reference, verdict, halves), control.decide
        projector = Projector(problem.geometry, problem.grid)
        volume = solve_views(
            state, projector, problem.views.masked(), nonnegative=not self.allow_negative,
            go_on=watched(control, problem.geometry.n_views, report=report), decide=decide,
        )  # fmt: skip
        if not state.moved.size:
            return None
        settings = {
            **decide.record, "seed": problem.seed, "reference_used": True, "reference_because": verdict.because,
            "reference_weight": verdict.weight,
        }  # fmt: skip
        return Reconstruction(
            volume, settings, tuple(history), method=self.name, chosen=f"The reference was used: {verdict.because}",
            change=Volume(volume.data - state.moved, volume.grid), displacement=state.displacement,
        )  # fmt: skip

    def preview(self, views: Views) -> Preview | None:
        """The moved reference plus FBP of its residual, on the voxels of these projections; see `preview_of`."""
        return None if self.reference is None else preview_of(self.reference, views)

    def at_height(self, above: float) -> Self:
        """With the reference at its height in a part of the volume."""
        if self.reference is None:
            return self
        z, y, x = self.reference.grid.centre
        return replace(
            self, reference=replace(self.reference, grid=replace(self.reference.grid, centre=(z - above, y, x)))
        )

    def with_quality(self, quality: Quality, default_count: int) -> Self:
        """The same as for `otherwise`; half voxels always with "best", and never with "preview"."""
        otherwise, wanted = self.otherwise.with_quality(quality, default_count), BY_QUALITY[quality]
        return replace(self, otherwise=otherwise, half_voxels=self.half_voxels if wanted is None else wanted)

    def toy(self) -> Self:
        return replace(self, otherwise=self.otherwise.toy())

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        reference_bytes, reference_grid = (
            (0, None) if self.reference is None else (self.reference.data.nbytes, self.reference.grid)
        )
        placed, smoothed = bytes_placed(reference_grid, grid, MARGIN)
        at_first = bytes_of(_START_BUFFERS, geometry, grid, weighted) + placed + smoothed
        later = bytes_of(_BUFFERS, geometry, grid, weighted) + _PLACED * placed
        if uses_half_voxels(self.half_voxels, geometry, grid, _FEW):
            on_halves = bytes_of(_HALF_VOXEL_BUFFERS, geometry, halved(grid), weighted)
            later = max(later, on_halves + _PLACED * placed)
        return reference_bytes + max(at_first, later, self.otherwise.memory(geometry, grid, weighted))


class _State:
    """Makes the volume after a verdict. Afterwards it also has the moved reference and the displacement.

    Attributes:
        moved: [z, y, x] in 1/mm; empty if the reference shows no material here.
        displacement: [axis z, y, x; z, y, x] in mm, from a voxel to the place in the reference from which it takes its
            value.
    """

    def __init__(self, reference: Volume, verdict: ReferenceVerdict, halves: bool) -> None:
        self._reference, self._verdict, self._halves = reference, verdict, halves
        self.moved = self.displacement = np.empty(0, np.float32)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        moved = if_it_overlaps(self._reference, problem)
        if moved is None:
            return x
        grid, width, verdict = problem.projector.grid, width_of(problem), self._verdict
        edge = problem.units.projector(problem.projector, 1).grid.voxel_size
        for basis, values in (
            (Basis.affine(grid, width), verdict.affine),
            (Basis.splines(grid, width, KNOTS).uniform_along_z(), verdict.splines),
        ):
            c = np.reshape(values, (-1, *basis.used.shape)) / edge
            c = c if basis.intervals else about_reference(c, self._reference, problem, width, -1)
            moved = replace(moved, u=moved.u + padded(replace(basis, axes=len(c)).field(c)))
        gains = np.full(moved.gains.shape, verdict.gains[1])
        gains[0] = verdict.gains[0]
        moved = replace(moved, gains=gains)
        weight = problem.units.prior(Prior(verdict.weight), problem.weight is not None, -1).weight
        start = moved.volume()
        if problem.wide or not start.any():
            problem.first_sweep(x, problem.rng)
            start = np.where(moved.known(), start, x)
        fit = StateFit(problem, moved, start.astype(np.float32), weight, width)
        fit.rounds(_ROUNDS, _FIRST_ITERATIONS)
        # on whole voxels, or from more projections, faint lines cost 0.1 to 0.2 dB, and cracks become no deeper
        geometry = problem.projector.geometry
        is_few = geometry.n_views < FEW * geometry.detector_shape[1]
        lines_from = ALL_LINES if self._halves and is_few else CLEAR_LINES
        fit.sharpen(_SHARPENING_ROUNDS, lines_from, _LAST_ITERATIONS)
        if self._halves and (count := fit.on_half_voxels(lines_from, _LAST_ITERATIONS)):
            problem.decide.settings["half_voxel_iterations"] = count
        problem.decide.ended = None  # it describes only the last of several rounds
        self.moved = volume_slices(times_power(fit.m.copy(), problem.units.density))
        self.displacement = np.float32(edge) * fit.moved.u[[2, 0, 1]].transpose(0, 3, 1, 2)
        return fit.x
