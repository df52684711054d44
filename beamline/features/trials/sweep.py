"""Sweep: the same slice with each value of one or two options, scored with held-out projections."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import NamedTuple

import numpy as np

from beamline.core.errors import DataError
from beamline.core.events import Sink
from beamline.core.machine import machine
from beamline.core.sinks import Warnings
from beamline.core.text import NUMBER
from beamline.features.trials.run_trial import TrialRun, TrialScan
from beamline.features.trials.runner import Planned
from beamline.features.trials.trial import HELD_OUT, MethodTrial, Outcome, TrialTable
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import hold_out
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.reconstruct.job import compile_kernels
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.scan_facts import facts_of
from beamline.report.sheets import COLUMNS, SliceSheet
from drivers.base.clock import Clock
from recon.base.arrays import F32, I64
from recon.base.empirical import ONE_IN
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.methods import BASELINE
from recon.voxels.choice import Prediction, TrialChoice
from recon.voxels.held_out import TRIAL_ROWS
from recon.voxels.projector import Projector, projection_lines
from recon.voxels.residuals import squares_left
from recon.voxels.resolution import ViewResolution

# share of the residual of a direct method that counts as no difference; with 0.03, an axis that was wrong by 0.7
# columns was called the best
_LEAST_CHANGE = 0.05
_NUMBER = re.compile(rf"[-+]?{NUMBER}")
_NO_SCORE = (
    "The table has no scores, because the values of this option change the pixels or the selection of projections, "
    "so that the slices cannot be compared with the same projections."
)
_OTHER_VIEWS = (
    "Look at the pictures first. Each value of this option corrects the projections differently, and the score of a "
    "slice needs projections to compare with. Therefore each slice is compared with the projections of all values, "
    "and its score is the mean. This mean favours values in the middle of the range."
)


@dataclass(frozen=True)
class SweptTrial(MethodTrial):
    """A trial of a sweep: a reconstruction with one value of each option.

    Attributes:
        settings: the values by the name of the option. options: the options of `beamline recon`.
    """

    options: ReconOptions = field(kw_only=True, hash=False)

    @property
    def label(self) -> str:
        """The options and their values."""
        return ", ".join(f"{name} {value}" for name, value in self.settings.items())

    @property
    def shown(self) -> str:
        """The label of the trial, because every slice is shown."""
        return self.label


class UnseenViews(NamedTuple):
    """The held-out projections of a trial, and the forward projection of its volume.

    Attributes:
        ids: rows of the projections in the file. data: [view, col, row], the projections after the corrections of this
            trial; pixels without data are NaN.
        model: [view, col, row], forward projection of the volume at this resolution.
        views: the projections that the trial used. Trials with the same projections have the same data.
    """

    ids: I64
    data: F32
    model: F32
    resolution: ViewResolution
    views: object

    def of(self, ids: I64) -> UnseenViews:
        """The projections with these rows of the file."""
        places = np.searchsorted(self.ids, ids)
        return UnseenViews(ids, self.data[places], self.model[places], self.resolution.select(places), self.views)


def sliced(trials: Sequence[ReconOptions]) -> list[ReconOptions]:
    """The same reconstruction options for a few rows around the middle.

    A direct method needs only the row of the slice; total variation and fits need some rows around it. For a cone beam,
    or if the user gave rows, all rows are reconstructed.

    Raises:
        ConfigError, DataError: the scan or the selection cannot be used.
    """
    halo = max(min(trial.method.halo, (TRIAL_ROWS - 1) // 2) for trial in trials)
    return [replace(trial, selection=_middle(trial, halo)) for trial in trials]


def _middle(trial: ReconOptions, halo: int) -> Selection:
    selection = trial.selection
    with trial.source.open() as source:
        part, n = select(source, selection).selection, selection.binning
    if selection.rows is not None or part.cone is not None:
        return selection
    rows = part.detector_rows
    height = min(2 * halo + 1, (rows.stop - rows.start) // n) * n
    first = rows.start + (rows.stop - rows.start - height) // 2
    return replace(selection, rows=(first, first + height), axis_rows=selection.axis_rows or (rows.start, rows.stop))


class SweptScan(TrialScan):
    """The scan of a sweep. If the values do not affect the correction, the projections are corrected only once for all
    values.

    The rotation axis is determined only once, so that slices differ only by the options. If the axis is swept, the
    projections are corrected with the middle one of the axes.

    Attributes:
        unseen: held-out projections of the finished trials, by label.
    """

    def __init__(self, trials: Sequence[SweptTrial], sink: Sink, clock: Clock) -> None:
        self._trials, self._sink, self._clock = trials, sink, clock
        self._first = repr(trials[0].options.source)
        self._axis = middle_axis([trial.options.selection for trial in trials])
        self._of_axes = self._axis is not None
        self._views: tuple[str, Selection, Views] | None = None
        self._used: Views | None = None
        self.unseen: dict[str, UnseenViews] = {}

    def asked_by(self, trial: MethodTrial) -> TrialRun:
        """The work of a trial. Raises ConfigError and DataError as `beamline recon` does."""
        assert isinstance(trial, SweptTrial)
        options, own_selection = trial.options, trial.options.selection
        views = self._corrected(options)
        self._used = views if own_selection.axis_col is None or not self._of_axes else _about(views, own_selection)
        geometry = self._used.seen.geometry
        compile_kernels(options, geometry, self._sink, self._clock)
        method, grid = options.method_for(geometry), Grid.matching(views.seen.geometry)
        return TrialRun(method, self._used, grid, options.seed, options.device)

    def _corrected(self, options: ReconOptions) -> Views:
        own_selection, source_words = options.selection, repr(options.source)
        its_own = not self._of_axes and (own_selection.axis_col is not None or source_words != self._first)
        wanted = own_selection if its_own else replace(own_selection, axis_col=self._axis)
        if self._views is None or self._views[:2] != (source_words, wanted):
            with options.source.open() as source:
                prepared = prepare_projections(select(source, wanted), Warnings(self._sink, self._clock))
            views = hold_out(prepared, ONE_IN, advice="take a scan with more projections").views
            if wanted.axis_col is None and source_words == self._first:
                self._axis = prepared.origin.axis_col
                wanted = replace(wanted, axis_col=self._axis)
            self._views = source_words, wanted, views
        return self._views[2]

    def measured(self, trial: MethodTrial, volume: Volume) -> tuple[Mapping[str, float], Sequence[float]]:
        """The residual in the held-out projections after the corrections of this trial, and its square in each
        projection."""
        used = self._used
        assert used is not None and self._views is not None
        held_out = used.unseen
        assert held_out is not None and held_out.ids is not None
        projector, data = Projector(held_out.geometry, volume.grid), held_out.data
        data = data if held_out.weights is None else np.where(held_out.weights[...] > 0, data, np.float32(np.nan))
        model = projector.forward(np.asarray(volume.data))
        unseen = UnseenViews(
            held_out.ids, projection_lines(data), projection_lines(model), projector.resolution, self._views[2]
        )
        self.unseen[trial.label] = unseen
        squares = squares_left(unseen.model, unseen.data, None, unseen.resolution)
        return {HELD_OUT: squares.residual}, squares.squares.tolist()

    def concluded(self, table: TrialTable) -> TrialTable:
        """The table in which scores replace the residuals of the trials in their own projections, with verdicts and
        remarks.

        Raises:
            DataError: no slice was made, or the held-out projections show no sample.
        """
        if not table.compared:
            reason = table.outcomes[0].message
            raise DataError(f"No slice was made. Reason for the first slice: {reason}.")
        direct = not self._trials[0].options.method.fitted
        if (scores := scores_of(self.unseen, direct=direct)) is None:
            outcomes = [replace(outcome, metrics={}) for outcome in table.outcomes]
            return replace(table, outcomes=tuple(outcomes), notes=[_NO_SCORE])
        choice, same_views = scores
        judged = {each.name: (share, verdict) for each, share, verdict in zip(
            choice.predictions, shares_of(choice), choice.verdicts, strict=True
        )}  # fmt: skip
        for row in table.todo:
            if (label := table.outcomes[row].trial.label) in judged:
                share, verdict = judged[label]
                metrics = {HELD_OUT: share}
                table = table.with_outcome(row, replace(table.outcomes[row], verdict=verdict, metrics=metrics))
        notes = [
            f"Use -m fista-tv to distinguish the values better: with {BASELINE} the residual is mostly the blur "
            "of its filter."
        ] * direct
        notes += [] if same_views else [_OTHER_VIEWS]
        if (best := table.best) is None:
            low, high = min(shares_of(choice)), max(shares_of(choice))
            best, nearly = {}, f"All scores are nearly the same ({low:.4g} to {high:.4g}), so no value is the best."
            notes.append(nearly)
        for name in best if same_views else ():
            tried = list(dict.fromkeys(trial.settings[name] for trial in self._trials))
            if len(tried) > 2 and best[name] in (tried[0], tried[-1]) and all(_NUMBER.fullmatch(str(v)) for v in tried):
                best_value = best[name]
                notes.append(f"The best {name} is at the end of the range, {best_value}: try values beyond it.")
        return replace(table, notes=notes)


def middle_axis(selections: Sequence[Selection]) -> float | None:
    """The axis with which all projections are corrected if the axis itself is swept; None if it is not swept.

    Some corrections compare the two sides of the axis. If each trial were corrected with its own axis, some trials
    would apply such a correction and others would not.
    """
    axes = sorted(each.axis_col for each in selections if each.axis_col is not None)
    return axes[len(axes) // 2] if len(axes) == len(selections) and axes[0] < axes[-1] else None


def _about(views: Views, selection: Selection) -> Views:
    """The same projections about the axis of the selection."""
    assert selection.axis_col is not None
    n = selection.binning
    return replace(views, geometry=replace(views.geometry, axis_col=(selection.axis_col - (n - 1) / 2) / n))


def scores_of(slices: Mapping[str, UnseenViews], *, direct: bool = False) -> tuple[TrialChoice, bool] | None:
    """The residual of the volume of each slice in the held-out projections, as a fraction of these projections; and
    True if all options give the same projections. None if slices differ in their pixels or in their held-out
    projections.

    A correction also changes the held-out projections: a correction that smooths would compare its volume with smoother
    projections. Therefore each volume is compared with the held-out projections after the correction of every value,
    and the mean of these residuals is the score.

    Args:
        direct: True if a direct method made the volumes. Their residual is mostly the blur of the filter.

    Raises:
        DataError: the held-out projections show no sample.
    """
    common = reduce(np.intersect1d, (each.ids for each in slices.values()))
    if len({each.model.shape[1:] for each in slices.values()}) > 1 or not common.size:
        return None
    unseen = [each.of(common) for each in slices.values()]
    judges = {id(each.views): each for each in reversed(unseen)}.values()  # the same resolution for all geometries
    if not all(np.isfinite(judge.data).any(axis=(1, 2)).all() for judge in judges):
        return None
    same = all(np.array_equal(judge.data, unseen[0].data, equal_nan=True) for judge in judges)
    sums = [[squares_left(each.model, judge.data, None, judge.resolution) for judge in judges] for each in unseen]
    scale = sum(math.sqrt(squares.own.mean()) for squares in sums[0])
    if scale == 0:
        raise DataError("The slices cannot be scored, because the held-out projections show no sample.")
    residuals = [np.sum([np.sqrt(squares.squares) for squares in row], axis=0) / scale for row in sums]
    predictions = (Prediction(name, residual.tolist()) for name, residual in zip(slices, residuals, strict=True))
    return TrialChoice(f"{len(common)} views", _LEAST_CHANGE if direct else 0.0, tuple(predictions)), same


def shares_of(choice: TrialChoice) -> list[float]:
    """[candidate] the residual in all held-out projections together, as in `recon.judgement`."""
    return [float(np.sqrt(np.square(residuals).mean())) for residuals in choice.residuals_by_number.values()]


Trials = Sequence[tuple[Mapping[str, str], ReconOptions]]
"""The values by option, and the options of `beamline recon` that have these values."""


def planned_sweep(trials: Trials, command: str, sink: Sink, clock: Clock) -> Planned:
    """Select the rows for the slice, and plan a trial for each combination of values.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    (first, options), *_ = trials
    swept = [
        SweptTrial("option", each.method.name, 0, values, options=each)
        for (values, _), each in zip(trials, sliced([each for _, each in trials]), strict=True)
    ]
    with options.source.open() as source:
        facts = dict(facts_of(source).table)
    rows = swept[0].options.selection.rows
    facts["row"] = "the middle one" if rows is None else str(sum(rows) // 2)
    across = len({values[[*first][1]] for values, _ in trials}) if len(first) > 1 else min(COLUMNS, len(trials))
    table = TrialTable(
        "sweep", f"{' and '.join(first)} of a slice", tuple(Outcome(each, "not run") for each in swept), HELD_OUT,
        machine(), facts, command, f"Which {' and '.join(first)} predicts held-out projections best?", asks_best=True,
    )  # fmt: skip
    scan = SweptScan(swept, sink, clock)
    return Planned(lambda run: scan, table, SliceSheet(across=across, closer=True))
