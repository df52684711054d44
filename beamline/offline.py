"""Offline reconstruction: a finished scan file in, a volume with its report out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import recon
from beamline.budget import within
from beamline.deliver import Target, deliver
from beamline.errors import DataError
from beamline.events import Event, Sink
from beamline.measure import fit_truth, read_truth
from beamline.pipeline import Prepared, Selection, prepare
from beamline.recon_report import Context, Made, facts_of
from beamline.stop import Stoppable, never_stopped
from beamline.storage.source import Quantity, ScanSource, open_scan
from drivers.clock import Clock
from recon.fbp import Filter
from recon.fit import Progress
from recon.initialise import default_count
from recon.quality import PRESETS, Quality
from recon.reconstruction import Method
from recon.volume import Grid
from recon.warm_up import warm_up


@dataclass(frozen=True)
class SourceOptions:
    """Which scan, and what to take instead of what its file says (see storage.source.open_scan)."""

    path: Path
    quantity: Quantity | None = None
    angles: Path | None = None
    angle_rows: str | None = None
    darks: Path | None = None
    flats: Path | None = None

    def open(self, *, follow: bool = False) -> ScanSource:
        return open_scan(
            self.path,
            angles=self.angles,
            angle_rows=self.angle_rows,
            darks=self.darks,
            flats=self.flats,
            quantity=self.quantity,
            follow=follow,
        )


@dataclass(frozen=True)
class ReconOptions:
    """What to reconstruct and how.

    Attributes:
        source: the scan.
        target: where results go.
        selection: which part of the scan, and its correction.
        method: of recon.reconstruct.
        steps: of the fit; None takes the reconstructor's own number.
        seconds: at most, for the fit; for a followed scan, after its end.
        budget: s for everything from line integrals to volume; chooses all settings of the fit.
        quality: a preset instead of steps and Gaussians.
        gaussians: how many to start from; None derives it from the volume.
        filter: of the FBP.
        seed: of everything random.
        truth: FILE or FILE:first:end to compare with.
        unfinished: take the frames that there are, where the scan still runs or died.
        command: that repeats this, for the record.
    """

    source: SourceOptions
    target: Target
    selection: Selection
    method: Method = "r2"
    steps: int | None = None
    seconds: float | None = None
    budget: float | None = None
    quality: Quality | None = None
    gaussians: int | None = None
    filter: Filter = "hann"
    seed: int = 0
    truth: str | None = None
    unfinished: bool = False
    command: str = ""


class Warnings:
    """Collects warnings for the report while it sends them on as events."""

    def __init__(self, sink: Sink, clock: Clock) -> None:
        self._sink, self._clock = sink, clock
        self.said: list[str] = []

    def __call__(self, text: str) -> None:
        if text not in self.said:
            self.said.append(text)
            self._sink(Event("warning", self._clock.now(), {"message": text}))


def run(options: ReconOptions, sink: Sink, clock: Clock, stoppable: Stoppable = never_stopped) -> dict[str, float]:
    """Reconstruct a finished scan. Returns the metrics; the event `done` says the rest.

    A fit that is stopped within `stoppable` delivers what it has, marked `ended_early`.

    Raises:
        ConfigError, DataError: with nothing written.
    """
    started = clock.now()
    options.target.refuse_existing()
    wanted = None if options.truth is None else read_truth(options.truth)
    warn = Warnings(sink, clock)
    with options.source.open() as source:
        if not source.finished:
            n = source.image_key.size
            if not options.unfinished:
                raise DataError(
                    f"{source.path} is still being written, or its scan died. Follow it with --follow, or take the {n} "
                    "frames that are there with --unfinished."
                )
            warn(f"The scan is unfinished: it still runs, or it died. The {n} frames that are there are used.")
        facts = facts_of(source)
        prepared = prepare(source, options.selection, warn)
    selection = options.selection
    if wanted is not None:  # before the work, not after it
        fit_truth(wanted, Grid.matching(prepared.geometry), selection.binning)
    announce(options, prepared, sink, clock)
    with stoppable() as stopped:
        if options.budget is None:
            made = reconstruct(options, prepared, Grid.matching(prepared.geometry), sink, clock, stopped)
        else:
            made, prepared, factor = spend(options, options.budget, prepared, sink, clock, stopped)
            selection = replace(selection, binning=selection.binning * factor)
    truth = None if wanted is None else fit_truth(wanted, made.volume.grid, selection.binning)
    context = Context(facts, selection, options.command, options.seed, warn.said, started)
    return deliver(made, prepared, truth, options.target, context, sink, clock)


def announce(options: ReconOptions, prepared: Prepared, sink: Sink, clock: Clock) -> None:
    """Say what is about to be reconstructed."""
    data = {
        "file": options.source.path,
        "method": options.method,
        "n_views": prepared.geometry.n_views,
        "n_projections": prepared.n_projections,
        "detector": prepared.geometry.detector_shape,
        "axis_col": prepared.axis_col,
        "axis_confident": None if prepared.axis is None else prepared.axis.confident,
    }
    sink(Event("recon_started", clock.now(), data))


def reconstruct(
    options: ReconOptions, prepared: Prepared, grid: Grid, sink: Sink, clock: Clock, stopped: Callable[[], bool]
) -> Made:
    """Run the reconstructor on prepared views."""
    steps, gaussians, said = options.steps, options.gaussians, ""
    if options.method == "r2":
        warm_up()  # so that the fit's time, and the time it says is left, hold no compilation
    if options.quality is not None:
        preset = PRESETS[options.quality]
        steps = preset.steps
        gaussians = max(1, round(preset.share * default_count(Grid.of_field(prepared.geometry, grid.voxel_size))))
        said = f"{options.quality}: {steps} steps from {gaussians} Gaussians"
    try:
        result = recon.reconstruct(
            prepared.projections.data,
            prepared.geometry,
            grid,
            method=options.method,
            steps=steps,
            gaussians=gaussians,
            seed=options.seed,
            filter=options.filter,
            seconds=options.seconds,
            on_progress=progress_events(sink, clock),
            should_stop=stopped,
            now=clock.now,
        )
    except ValueError as error:
        raise DataError(f"{options.source.path} cannot be reconstructed by {options.method}: {error}") from error
    return Made(
        volume=result.volume,
        method=options.method,
        seconds=result.seconds,
        history=result.history,
        settings={**result.settings, **({"ended_early": True} if stopped() and options.method != "fbp" else {})},
        filter=options.filter,
        chosen=said,
    )


def spend(
    options: ReconOptions, budget: float, prepared: Prepared, sink: Sink, clock: Clock, stopped: Callable[[], bool]
) -> tuple[Made, Prepared, int]:
    """Reconstruct within a budget of seconds: what was made, of which views, and how many pixels were joined a side."""
    warm_up()  # compilation happens once on a machine; no budget pays for it
    try:
        done = within(budget, prepared, options.seed, options.filter, clock.now, progress_events(sink, clock), stopped)
    except ValueError as error:
        raise DataError(f"{options.source.path} cannot be reconstructed: {error}") from error
    early = {"ended_early": True} if stopped() and done.choice.method != "fbp" else {}
    made = Made(
        volume=done.result.volume,
        method=done.choice.method,
        seconds=done.seconds,
        history=done.result.history,
        settings={**done.result.settings, **done.settings(budget), **early},
        filter=options.filter,
        chosen=done.said(budget),
    )
    return made, done.prepared, done.choice.binning


def progress_events(sink: Sink, clock: Clock) -> Callable[[Progress], None]:
    """A listener that passes the fit's progress on as events."""

    def listen(progress: Progress) -> None:
        sink(Event("progress", clock.now(), {"stage": "recon", **asdict(progress)}))

    return listen
