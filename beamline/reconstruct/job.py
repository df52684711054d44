"""Job: prepares the projections of a source and reconstructs the volume, in one piece or in slabs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import recon
from beamline.core.durations import Phases, seconds_left
from beamline.core.errors import DataError
from beamline.core.events import KernelsCompiled, Sink, StateEntered
from beamline.core.recon_events import FitReached
from beamline.core.sinks import Warnings
from beamline.core.stop import StopScope
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.budget import in_budget
from beamline.reconstruct.checkpoints import origin_of
from beamline.reconstruct.memory import cluster
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.region import RegionOfRows
from beamline.reconstruct.run import deviation_by_slabs, deviation_of, run_on, without_outside
from beamline.reconstruct.scan_facts import ScanFacts
from beamline.reconstruct.slab_run import RunMethod, SlabWorkers, in_slabs
from drivers.base.clock import Clock
from recon.base.arrays import F32, F64
from recon.base.decisions import Decisions, Stop
from recon.base.geometry import Geometry
from recon.base.method import (
    Ending,
    Method,
    Progress,
    Reconstruction,
    RunControl,
)
from recon.base.method_kinds import Series
from recon.base.slabs import Slab
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.error_bars import method_on_voxels
from recon.splatting.fit_method import Fit
from recon.splatting.time_limit import FinalFit
from recon.voxels.projector import measured_share
from recon.warm_up import warm_up


def progress_events(
    sink: Sink, clock: Clock, seconds: float | None = None, waiting: Callable[[], int] = lambda: 0
) -> Callable[[Progress], None]:
    """A listener that forwards progress as events, with steps per second (`per_s`) and the estimated remaining time in
    s (`eta_s`; None if it is not known).

    Args:
        seconds: time limit of the fit, if no number of steps is planned.
        waiting: gives the number of projections that the fit has not used yet.
    """
    first: Progress | None = None
    step = 0

    def on_progress(progress: Progress) -> None:
        nonlocal first, step
        if first is None or progress.step < step:  # the fit of a followed scan may start again
            first = progress
        step = progress.step
        n_done, spent = progress.step - first.step, progress.seconds - first.seconds
        rate = n_done / spent if n_done > 0 and spent > 0 else None
        eta = None
        if progress.steps:  # the remaining time of this part of the work only
            eta = seconds_left(n_done, progress.steps - first.step, spent)
        elif seconds is not None and not progress.unit:
            eta = max(0.0, seconds - spent)
        sink(FitReached("recon", **vars(progress), per_s=rate, eta_s=eta, waiting=waiting(), time=clock.now()))

    return on_progress


def compilation_events(sink: Sink, clock: Clock) -> Callable[[int], None]:
    """A listener that forwards the number of kernels compiled so far as events."""
    begin = clock.now()

    def compiled(n: int) -> None:
        now = clock.now()
        sink(KernelsCompiled("kernels", n, now - begin, time=now))

    return compiled


def corrections_done(messages: Mapping[str, str], sink: Sink, clock: Clock) -> None:
    """Report what each correction did to the projections; empty texts are left out."""
    for state, message in messages.items():
        if message:
            sink(StateEntered(state, message, time=clock.now()))


@dataclass(frozen=True, eq=False)
class Channels:
    """Events, warnings, clock and stop requests of one reconstruction.

    Attributes:
        stop_scope: context in which the work can be stopped with the volume reached so far.
        started: time at which the call started, by `clock`.
        worked: CPU time in s that this process had used when the call started.
    """

    sink: Sink
    clock: Clock
    warn: Warnings
    phases: Phases
    stop_scope: StopScope
    started: float
    worked: float


@dataclass(frozen=True, eq=False)
class Job:
    """A reconstruction: the prepared projections, and how the volume is computed from them.

    Attributes:
        options: the options, with the rows that show the region and the time that remains for the method.
        facts: reads the facts of the scan, after the volume is done.
        stopping: context in which the work can be stopped with the volume reached so far.
        stop: the stop request of the context that is open now.
        truth: the ground truth [z, y, x] with which the volume is compared; None: there is no ground truth.
        slabs: the slabs in which the volume is reconstructed; empty: in one piece.
        final_fit: last part of a fit that has grown with the projections; None: the method of the options is used.
        leaves: function that returns True if this number of seconds is left before the report.
    """

    options: ReconOptions
    channels: Channels
    prepared: PreparedProjections
    facts: Callable[[], ScanFacts]
    stopping: StopScope
    stop: Stop = field(default_factory=Stop)
    truth: F32 | None = None
    slabs: Sequence[Slab] = ()
    region: RegionOfRows | None = None
    final_fit: FinalFit | None = None
    leaves: Callable[[float], bool] = lambda seconds: True

    @property
    def grid(self) -> Grid:
        """Grid of the volume; for a direct method, the grid of the requested region only."""
        grid = Grid.matching(self.prepared.geometry)
        return self.region.grid_of(grid) if self.region is not None and self.options.method.makes_boxes else grid

    @property
    def method(self) -> Method:
        """The method that reconstructs the volume from these projections."""
        return self.final_fit or self.options.method_for(self.prepared.geometry)

    def say(self, text: str, state: str = "slab") -> None:
        """Report the progress of a slab, or that the job has entered another state."""
        self.channels.sink(StateEntered(state, text, time=self.channels.clock.now()))

    def listener(self, seconds: float | None = None) -> Callable[[Progress], None]:
        return progress_events(self.channels.sink, self.channels.clock, seconds)


@contextmanager
def refused(path: Path | str, by: str = "") -> Iterator[None]:
    """Convert a ValueError to a DataError that names the file."""
    try:
        yield
    except ValueError as error:
        raise DataError(f"{path} cannot be reconstructed{by}: {error}") from error


def compile_kernels(options: ReconOptions, geometry: Geometry, sink: Sink, clock: Clock) -> None:
    """Compile the kernels in this process (only once per computer) and report it. Cluster workers compile their own.

    The time for the compilation counts neither as time of the run nor in the estimated remaining time.
    """
    method, compiled = options.method, compilation_events(sink, clock)
    methods = method.alternatives if options.budget is not None else (method,)
    for candidate in methods if options.cluster is None else ():
        with refused(options.source.path, f" by {candidate.name}"):
            warm_up(candidate, geometry, device=options.device, on_kernel=compiled)


def runner_of(
    options: ReconOptions, reconstruct: Callable[..., Reconstruction] = recon.reconstruct, times: F64 | None = None
) -> RunMethod:
    """Call `run_on` with the seed and device of the options. Errors of the method name the scan file."""

    def run(method: Method, views: Views, grid: Grid, control: RunControl) -> Reconstruction:
        with refused(options.source.path, f" by {method.name}"):
            return run_on(method, views, grid, options.seed, control, options.device, reconstruct, times)

    return run


def volume_of(job: Job, decided: Decisions) -> tuple[Reconstruction, PreparedProjections]:
    """Reconstruct in slabs or in one piece. Returns the volume (0 if no ray passes through it) and the projections
    used.
    """
    result, used = _volume_of(job, decided)
    lost, volume, geometry = np.setdiff1d(*used.unmeasured_rows), result.volume, used.geometry
    if lost.size and geometry.is_cone:
        share = measured_share(~np.isin(np.arange(geometry.detector_shape[0]), lost), geometry, volume.grid)
        volume.data[share <= 0] = 0
    elif lost.size and geometry.rows_show_slices and len(volume.data) == geometry.detector_shape[0]:
        volume.data[lost] = 0
    return result, used


def _volume_of(job: Job, decided: Decisions) -> tuple[Reconstruction, PreparedProjections]:
    prepared, budget = job.prepared, job.options.budget
    if budget is not None:
        with refused(job.options.source.path):
            method, words = in_budget(
                job.method, budget, prepared.geometry, prepared.box, job.channels.clock.now, job.channels.warn
            )
        job.say(words, "budget")
        result, used = _volume_of(replace(job, options=replace(job.options, method=method, budget=None)), decided)
        chosen = f"{result.chosen or result.method}; {words}"
        return replace(result, chosen=chosen, settings={**result.settings, "budget": budget}), used
    if not job.slabs:
        result = _at_once(job, decided)
        return replace(result, outside=None), without_outside(prepared, result)
    result = _by_slabs(job, decided)
    if not job.options.method.weighs and prepared.sources.view_weights is not None:
        # Only recorded, because FBP and its figures of merit treat all rays equally.
        result = replace(result, settings={**result.settings, "view_weights": prepared.sources.view_weights})
        prepared = replace(prepared, sources=replace(prepared.sources, view_weights=None))
    return result, prepared


def _ended(result: Reconstruction, ending: Ending, chosen: str = "") -> Reconstruction:
    """The result with how it ended and why its method was chosen, without data that only a resumed fit would need."""
    chosen = chosen or (result.chosen and f"{result.method}: {result.chosen}")
    return replace(result, chosen=chosen, ending=ending, checkpoint=None, at=None)


def with_error_bars(job: Job, result: Reconstruction, decided: Decisions) -> Reconstruction:
    """The volume with the standard deviation of each voxel. If this computation is stopped, the volume is returned
    without the standard deviation, and a warning is given.
    """
    if result.ending.early:
        job.channels.warn("No error bars were computed, because the reconstruction was stopped.")
        return result
    job.say(
        "The volume is done; its error bars are computed next. Press Ctrl-C to leave out the error bars.", "error_bars"
    )
    method = job.options.method_for(job.prepared.geometry)
    method = {each.name: each for each in method.alternatives}.get(result.method, method)
    control = RunControl(job.stop, job.listener(), now=job.channels.clock.now)

    reason = "their computation was stopped"
    try:
        if job.slabs:
            deviation = deviation_by_slabs(
                result.volume, method, job.prepared, job.options, job.slabs, decided.made, control, job.say
            )
        else:
            deviation = deviation_of(result.volume, method, job.prepared.views, job.options, decided.made, control)
    except ValueError as error:  # do not discard a volume that may have taken hours
        deviation, reason = None, str(error)
    if deviation is None:
        job.channels.warn(f"No error bars were computed: {reason}. The volume is complete.")
        return result
    factors = method_on_voxels(method, decided.made).error_bars
    assert factors is not None
    settings = dict(zip(("error_bars_spread", "error_bars_gradient"), factors, strict=True))
    return replace(result, deviation=deviation, settings={**result.settings, **settings})


def _at_once(job: Job, decided: Decisions) -> Reconstruction:
    """Run a method on the whole volume. Saves checkpoints, and continues from one, if the options ask for it."""
    options, prepared, checkpoints, method = job.options, job.prepared, job.options.checkpoints, job.method
    origin, resume, steps = {}, None, 0
    if checkpoints.wanted:
        assert isinstance(method, Fit)  # other methods do not reach this line: the options raised an error
        settings, others = method.provenance
        origin, steps = origin_of(prepared, settings, {"seed": options.seed, **others}), method.planned_steps or 0
        resume = checkpoints.begin(origin, steps, job.channels.warn)
    lost = ""  # the reason if the last checkpoint could not be written

    def keep(state: Mapping[str, NDArray[Any]]) -> None:
        nonlocal lost
        lost = checkpoints.write(origin, steps, job.channels.warn, state)

    control = RunControl(
        job.stop,
        job.listener(method.time_limit),
        None if checkpoints.path is None else keep,
        resume=resume,
        now=job.channels.clock.now,
        decide=decided if options.uncertainty else None,
    )
    result = runner_of(options, times=prepared.times)(method, prepared.views, job.grid, control)
    if result.checkpoint is not None:
        keep(result.checkpoint)
    if "held_out" in method.takes:
        result = replace(result, settings={k: v for k, v in result.settings.items() if k != "held_out"})
    resumed_from = "" if checkpoints.resume is None else str(checkpoints.resume)
    return _ended(result, Ending(_is_early(job, result), resumed_from, lost), _of_preset(job, result))


def _of_preset(job: Job, result: Reconstruction) -> str:
    """Steps and Gaussians of a preset, in words. Without a preset: warn if a fit started with too few Gaussians."""
    method, started_from = job.method, result.started_from
    if not isinstance(method, Fit):
        return ""
    if job.options.quality is not None:
        return f"{job.options.quality}: {method.steps} steps from {started_from} Gaussians"
    requested = method.gaussians
    if isinstance(requested, int) and job.options.checkpoints.resume is None and started_from < requested:
        job.channels.warn(
            f"The fit started with {started_from} Gaussians instead of {requested}, because the sample is too small "
            "for more."
        )
    return ""


def _is_early(job: Job, result: Reconstruction) -> bool:
    """Whether a stop request ended the method before its last step."""
    method = job.method
    # Voxel refinement, and the factors of several volumes, come after the last step and can also be stopped.
    if isinstance(method, Series) or (isinstance(method, Fit) and method.finish_sweeps > 0):
        return job.stop.stopped
    if ended := result.settings.get("ended"):  # iterations that end by themselves, before their largest number
        return job.stop.stopped and ended == "stopped"
    return job.stop.cut(*((result.history[-1].step, result.history[-1].steps) if result.history else (0, 0)))


def _by_slabs(job: Job, decided: Decisions) -> Reconstruction:
    """Run a method slab by slab."""
    options = replace(job.options, method=job.method)
    control = RunControl(job.stop, job.listener(), now=job.channels.clock.now, decide=decided)

    with nullcontext() if options.cluster is None else cluster(options.cluster) as connected:
        workers = None
        if connected is not None:
            workers = SlabWorkers(connected.workers, runner_of(options, connected.reconstruct))
        result = in_slabs(
            runner_of(options), job.prepared, options, job.slabs, control, job.say, job.channels.warn, workers
        )
    return _ended(result, replace(result.ending, early=job.stop.stopped))
