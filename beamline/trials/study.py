"""Runs a study: each row by each method in a process of its own, all compared with the FBP of the whole scan."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import Done, Event, Sink, StudyStarted, TrialDone, TrialReached
from beamline.core.files import result_folder
from beamline.core.machine import machine
from beamline.core.sinks import Warnings
from beamline.report.slice_sheet import SliceSheet
from beamline.trials.data import Data, write_array
from beamline.trials.launch import compile_kernels, run_trial
from beamline.trials.opened import ComparedScan, OpenedScan, opened_scan, until_stopped
from beamline.trials.study_figures import write_page
from beamline.trials.study_table import Cell, StudyTable, write_table
from beamline.trials.trial import Outcome, Timed, Trial, in_time, seconds_left
from beamline.trials.view_choices import Study, StudyRow, ViewSet, averaged
from drivers.base.clock import Clock
from recon.assess import metrics
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import Plain
from recon.methods import BASELINE
from recon.voxels.emission import Emission, weighted_lines
from recon.voxels.fbp import Filter

REFERENCE = "FBP of all views"


@dataclass(frozen=True)
class StudyOptions:
    """The scan and the study.

    Attributes:
        scan: the study chooses from its views.
        methods: names in `recon.methods`.
        settings: of these methods, by name; methods left out have their own.
        seconds: of each row, the same for all methods; None: methods end when their work is done.
        filter: of the FBP of all views that rows are compared with.
        draws: how often random views are drawn.
    """

    scan: ComparedScan
    study: Study
    methods: Sequence[str]
    settings: Mapping[str, Mapping[str, Plain]] = field(default_factory=dict)
    seconds: float | None = None
    filter: Filter = "shepp-logan"
    draws: int = 3
    seed: int = 0
    command: str = ""


@dataclass(frozen=True, eq=False)
class _Judge:
    """What every volume is compared with.

    Attributes:
        reference: FBP of all views, on `Grid.matching` of their geometry.
        truth: on the same grid; None where nobody knows it.
        mask: of the dense and the empty regions, see `_regions`; None without two.
    """

    reference: F32
    truth: F32 | None
    mask: NDArray[np.int8] | None

    def figures(self, volume: F32) -> dict[str, float]:
        """By the names of `table.HEADINGS`."""
        found = {"psnr_fbp": metrics.psnr(self.reference, volume), "ssim_fbp": metrics.ssim3d(self.reference, volume)}
        if self.truth is not None:
            found |= {"psnr_truth": metrics.psnr(self.truth, volume), "ssim_truth": metrics.ssim3d(self.truth, volume)}
        if self.mask is not None:
            found["snr"], found["cnr"] = metrics.snr_cnr(metrics.sampled(volume), self.mask)
        return found


def _regions(reference: F32, seed: int) -> NDArray[np.int8] | None:
    """Dense and empty regions, whole as published; None without contrast."""
    try:
        return metrics.kmeans_mask(metrics.sampled(reference), seed)
    except ValueError:
        return None


def run_study(options: StudyOptions, sink: Sink, clock: Clock, now: Callable[[], float] = time.monotonic) -> StudyTable:
    """Run all rows and write table, pictures and page into the folder. The event `done` names the folder.

    The table is written after every row. After Ctrl-C the table is `stopped`. A folder without results is removed. The
    views lie in a file of the folder while the study runs; the memory holds the views of one row.

    Raises:
        ConfigError, DataError: nothing was written, or the table of the rows that were done.
        KeyboardInterrupt: before the first row was done; nothing was written.
    """
    folder, started, path = options.scan.folder, clock.now(), options.scan.source.path
    warn = Warnings(sink, clock)
    scan = opened_scan(options.scan, warn)
    table = _planned(options, scan)
    todo = [cell for cell in table.cells if cell.row.groups is not None]
    if not todo:
        raise DataError(
            f"{path}: {scan.prepared.geometry.n_views} views are too few for any row of {options.study.name}: "
            f"{table.cells[-1].said}. Take a scan with more views."
        )
    left_out = len(table.cells) - len(todo)
    sink(StudyStarted(path, len(todo), left_out, options.study.name, time=clock.now()))
    for cell in table.cells:
        if cell.row.groups is None and cell.method == options.methods[0]:
            warn(f"{cell.row.label} is left out: {cell.message}")
    slices = SliceSheet()
    with result_folder(folder) as work:
        write_array(work / "views.npy", scan.prepared.projections.data)
        if (rays := scan.prepared.rays_there()) is not None:
            write_array(work / "rays.npy", rays)
        prepared = scan.prepared
        rig = Rig(work, prepared.geometry, options.seed, options.settings, prepared.emission, options.seconds)
        truth = scan.truth
        del scan, prepared, rays  # from here on the views are in the file alone
        whole = StudyRow(REFERENCE, np.arange(rig.geometry.n_views)[:, None])
        reference, outcome = rig.reconstructed(whole, BASELINE, {"filter": options.filter})
        if reference is None:
            raise DataError(f"{path}: the FBP of all views, to compare with, failed: {outcome.message}")
        judge = _Judge(reference, truth, _regions(reference if truth is None else truth, options.seed))
        slices.add(REFERENCE, reference)
        if truth is not None:
            slices.add("truth", truth)
        rig.compile(options.methods)

        def stamped(event: Event) -> None:
            sink(replace(event, time=clock.now()))

        table = until_stopped(table, _each(table, rig, judge, slices, stamped, now), folder, write_table)
    write_page(folder, table, slices)
    summary = {"output": folder, "rows": len(todo), "done": table.n_done, "stopped": table.stopped}
    sink(Done({**summary, "seconds": clock.now() - started}, time=clock.now()))
    return table


def _planned(options: StudyOptions, scan: OpenedScan) -> StudyTable:
    """The table before any row is done."""
    geometry, truth = scan.prepared.geometry, scan.truth is not None
    turns = np.stack((geometry.roll, geometry.tilt), axis=1) * max(geometry.detector_shape) / 2
    places = np.concatenate((geometry.shifts, turns), axis=1)
    rows = options.study.rows(ViewSet(geometry.angles, geometry.period, options.seed, options.draws, places))
    notes = [
        f"PSNR and SSIM are against the {REFERENCE} ({geometry.n_views}, {options.filter}): it has noise and streaks "
        "of its own, which rows share as far as they share its views.",
        "SNR and CNR are of the whole dense and empty region, with their rims (k-means of the "
        + ("truth" if truth else "FBP of all views")
        + "); a smoother volume has more.",
    ]
    for method, settings in options.settings.items():
        if settings:
            notes.append(f"{method}: {', '.join(f'{name} {value}' for name, value in settings.items())}.")
    if options.seconds is not None:
        notes.append(f"Each row had {options.seconds:g} s; direct methods take what they take.")
    if truth:
        notes.insert(1, "PSNR truth and SSIM truth are against the truth.")
    return StudyTable(
        options.study,
        tuple(Cell(row, method, message=row.reason) for row in rows for method in options.methods),
        {**scan.facts, "views to choose from": str(geometry.n_views)},
        machine(),
        options.command,
        notes,
        light=scan.light,
    )


@dataclass(frozen=True, eq=False)
class Rig:
    """Where rows are reconstructed: a folder with the views of the scan, views.npy, and their geometry.

    Where rays have weights, rays.npy has them. Where the sample emits, `emission` has the counts behind the views.
    `seconds`: of each row, as in `StudyOptions`.
    """

    work: Path
    geometry: Geometry
    seed: int
    settings: Mapping[str, Mapping[str, Plain]]
    emission: Emission | None = None
    seconds: float | None = None

    def trial(self, method: str, n_views: int, settings: Mapping[str, Plain] | None = None) -> Trial:
        """A row by a method, by `settings` instead of the method's own."""
        own = dict(self.settings.get(method, {}) if settings is None else settings)
        return in_time(Trial("method", method, n_views, settings=own), self.seconds)

    def reconstructed(
        self, row: StudyRow, method: str, settings: Mapping[str, Plain] | None = None
    ) -> tuple[F32 | None, Outcome]:
        """The volume of a row, by `settings` instead of the method's own; None if the method failed."""
        assert row.groups is not None
        # Opened here and closed with the return: Windows removes no file that is open.
        data, angles = averaged(np.load(self.work / "views.npy", mmap_mode="r"), self.geometry.angles, row.groups)
        angles.setflags(write=False)
        geometry = replace(self.geometry.select(row.groups[:, row.window // 2]), angles=angles)
        weights = None
        if (self.work / "rays.npy").exists():
            of_scan = np.load(self.work / "rays.npy", mmap_mode="r")
            weights = np.stack([of_scan[group].min(axis=0) for group in row.groups])
        counted = None
        if self.emission is not None:  # of a window the counts are added
            counted = self.emission.summed(row.groups, geometry)
            data, weights = weighted_lines(counted)
        Data(data, geometry, None, None, weights, counted).save(self.work / "data.npz")
        del data
        kept = self.work / "volume.npy"
        outcome = run_trial(self.trial(method, row.n_views, settings), self.work, self.seed, keep=kept)
        return (np.load(kept), outcome) if outcome.status == "done" else (None, outcome)

    def compile(self, methods: Sequence[str]) -> None:
        """Compile the kernels of these methods; the folder has the data of a row."""
        compile_kernels([self.trial(method, 2) for method in methods], self.work)


def _each(
    table: StudyTable, rig: Rig, judge: _Judge, slices: SliceSheet, sink: Sink, now: Callable[[], float]
) -> Iterator[StudyTable]:
    """The table after each cell, and after one that Ctrl-C interrupted."""
    timed: list[Timed] = []
    todo = [(index, cell) for index, cell in enumerate(table.cells) if cell.row.groups is not None]
    trials = [rig.trial(cell.method, cell.row.n_views) for _, cell in todo]
    begin = now()
    for n, (index, cell) in enumerate(todo):
        eta, rate = seconds_left(timed, trials[n:]), 60 * n / max(now() - begin, 1e-9)
        sink(TrialReached("study", n, len(todo), cell.label, eta, rate))
        started = now()
        try:
            volume, outcome = rig.reconstructed(cell.row, cell.method)
            figures = {} if volume is None else judge.figures(volume)
        except KeyboardInterrupt:
            yield table.with_cell(index, replace(cell, status="interrupted", message="ended before it was done"))
            raise
        if volume is not None:
            slices.add(cell.label, volume, cell.row.family, cell.method)
        cell = replace(
            cell, status=outcome.status, figures=figures, seconds=outcome.seconds, cpu_seconds=outcome.cpu_seconds,
            message=outcome.message, seconds_asked=outcome.trial.seconds_asked, reached=outcome.reached,
        )  # fmt: skip
        timed.append(Timed.of(outcome, now() - started))
        table = table.with_cell(index, cell)
        yield table
        said, quality = (cell.status, cell.seconds, cell.message), figures.get("psnr_fbp", math.nan)
        more = {"method": cell.method, **figures}
        sink(TrialDone(n + 1, len(todo), cell.label, *said, quality, outcome.peak_bytes, more))
