"""Offline reconstruction: a finished scan file in, a volume with its report out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from numpy.typing import NDArray

import recon
from beamline.core.errors import ConfigError, DataError
from beamline.core.events import ReconStarted, Sink, StateEntered
from beamline.core.phases import Phases
from beamline.core.sinks import Warnings
from beamline.core.stop import StopScope, never_stopped
from beamline.projections.held_out import hold_out, with_held_out
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.budget import within
from beamline.reconstruct.checkpoints import origin_of
from beamline.reconstruct.cluster import connected, refuse_unusable
from beamline.reconstruct.error_bars import deviation_by_slabs, deviation_of, made_by, refuse_impossible, refuse_views
from beamline.reconstruct.in_time import fit_within, warnings_told
from beamline.reconstruct.measure import fit_truth, read_truth
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.outcome import ReportContext, facts_of
from beamline.reconstruct.output_paths import OutputPaths
from beamline.reconstruct.progress import compilation_events, corrections_done, progress_events
from beamline.reconstruct.region import RegionOfRows, locate
from beamline.reconstruct.remarks import partly_seen_warning
from beamline.reconstruct.result import write_result
from beamline.reconstruct.slab_run import SlabWorkers, in_slabs, keeping
from beamline.reconstruct.slabs import prepare_within
from beamline.storage.interrupted import next_step
from beamline.storage.readers.base import ScanSource
from beamline.storage.writers.recon_file import SUFFIXES
from drivers.base.clock import Clock
from recon.base.decisions import Decisions
from recon.base.method import (
    BoundedMethod,
    CheckpointedMethod,
    DataUse,
    Method,
    Progress,
    Reconstruction,
    RunControl,
    candidates_of,
    volumes_of,
)
from recon.base.slabs import Slab
from recon.base.stop import Stop
from recon.base.volume import Grid
from recon.error_bars import method_on_voxels
from recon.splatting.backend import backend_for
from recon.splatting.fit_method import FitMethod
from recon.warm_up import warm_up

_HELD_OUT_ONE_IN = 10  # one of so many views is held out for --early-stop


def reconstruct_file(
    options: ReconOptions, sink: Sink, clock: Clock, stop_scope: StopScope = never_stopped
) -> dict[str, float]:
    """Reconstruct a finished scan. Returns the metrics; the event `done` says the rest.

    A reconstruction that is stopped within `stop_scope` writes the volume so far, marked `ended_early`. One by a direct
    method is interrupted like all else, with nothing written; one in slabs keeps those that are finished.

    Raises:
        ConfigError, DataError: with nothing written.
        ScanStopped: interrupted, with slabs to go on from.
    """
    started, worked, phases = clock.now(), time.process_time(), Phases(sink, clock)
    warn = Warnings(sink, clock)
    phases.enter("opening the scan")
    _refuse_impossible(options)
    truth_given = None if options.truth is None else read_truth(options.truth)
    with options.source.open() as source:
        require_finished(source, options)
        facts, options = facts_of(source), options.around_region(source)
        prepared, slabs = prepare_within(source, options, sink, clock, warn, phases)
    prepared = _for_method(options, prepared, slabs, sink, clock, warn)
    if truth_given is not None:  # before the work
        fit_truth(truth_given, Grid.matching(prepared.geometry), options.selection.binning)
    announce(options, prepared, sink, clock)
    if few := partly_seen_warning(prepared.geometry):
        warn(few)
    region = None if options.region is None else locate(options.region, options.selection, prepared.geometry)
    with keeping(options.partial_path) if slabs else nullcontext():
        phases.enter("compiling kernels")
        job = _Job(options, prepared, sink, clock, Stop(), warn, region)
        job.compile_kernels()
        phases.enter("reconstruction")
        before_report = Stop()
        if isinstance(options.method, BoundedMethod) and options.method.seconds is not None:
            method, before_report = fit_within(options.method, prepared, options.target, (started, worked), clock, warn)
            job = replace(job, options=replace(options, method=method))
        # A direct method and a slab have no volume so far: a signal interrupts them.
        stopping = never_stopped if job.options.method.traits.direct or slabs else stop_scope
        decided = Decisions(options.seed)
        with stopping() as stopped, warnings_told(warn):
            done = _volume(replace(job, stop=Stop(stopped)), slabs, decided)
        if options.uncertainty:
            phases.enter("error bars")
            with stop_scope() as stopped, warnings_told(warn):
                job = replace(job, stop=Stop(stopped))
                done = replace(done, made=_with_error_bars(job, done.made, slabs, decided))
        selection = replace(options.selection, binning=options.selection.binning * done.factor)
        truth = None if truth_given is None else fit_truth(truth_given, done.made.volume.grid, selection.binning)
        context = ReportContext(
            facts, selection, options.command, options.seed, warn.messages, started, recipe=options.recipe,
            region=region, phases=phases, leaves=before_report.leaves, filter=options.filter, chosen=done.chosen,
        )  # fmt: skip
        partial_volume = options.partial_path if slabs and options.becomes_output else None
        with stopping():  # the volume is there: the first signal no longer discards it
            metrics = write_result(
                done.made, done.prepared, truth, options.target, context, sink, clock, partial_volume
            )  # fmt: skip
        del done  # Windows removes no file that is mapped
    return metrics


def _refuse_impossible(options: ReconOptions) -> None:
    """Raises ConfigError and DataError for what shows before the scan is read."""
    options.target.refuse_existing()
    options.checkpoints.refuse_existing()
    check_device(options.device)
    options.refuse_contradictions()
    if options.method.traits.in_time:
        _require_hdf5(options.target)
    if options.uncertainty:
        refuse_impossible(options)
    if options.cluster is not None:
        refuse_unusable(options.cluster)  # now, before the correction of the scan


def _for_method(
    options: ReconOptions,
    prepared: PreparedProjections,
    slabs: Sequence[Slab],
    sink: Sink,
    clock: Clock,
    warn: Warnings,
) -> PreparedProjections:
    """The views as the method takes them, with some held out where it ends early, after their disk was looked at.

    Raises:
        ConfigError, DataError: the views do not suffice, or the disk does not.
    """
    if options.uncertainty:
        refuse_views(options.method_for(prepared.geometry), prepared.geometry)
    if options.cluster is not None and not slabs:
        warn("The volume fits into the memory and is made here, without --cluster; a smaller --memory makes slabs.")
    if options.stops_early and prepared.held_out is None:
        prepared = hold_out(prepared, _HELD_OUT_ONE_IN, advice="leave out --early-stop")
        n = prepared.projections.view_ids.size
        message = f"{prepared.n_projections - n} of {prepared.n_projections} views are held out to say when to stop"
        sink(StateEntered("held_out", message, time=clock.now()))
    volume = 4 * volumes_of(options.method) * math.prod(Grid.matching(prepared.geometry).shape)
    volumes = volume * options.target.written * (1 + options.uncertainty)
    options.target.require_room(*(options.disk_needs(volume) if slabs else (volumes, 0)))
    return prepared


def require_finished(source: ScanSource, options: ReconOptions) -> None:
    """Raises DataError for an unfinished scan, unless it is to be taken as it is."""
    if source.finished or options.unfinished:
        return
    raise DataError(
        f"{source.path} is not finished. {next_step(source.path)} --unfinished takes the {source.image_key.size} "
        "frames that are there as they are. Nothing was written."
    )


def announce(options: ReconOptions, prepared: PreparedProjections, sink: Sink, clock: Clock) -> None:
    """Report the requested corrections of the views, then send the event `recon_started`."""
    corrections_done({name: done.sentence for name, done in prepared.done.items() if not done.warned}, sink, clock)
    views, confident = prepared.geometry, None if prepared.axis is None else prepared.axis.confident
    more = {"n_projections": prepared.n_projections, "detector": views.detector_shape, "axis_confident": confident}
    sink(
        ReconStarted(
            options.source.path, options.method.name, views.n_views, prepared.axis_col, more=more, time=clock.now()
        )
    )


def check_device(device: str) -> None:
    """Raises ConfigError if a fit cannot compute on the device."""
    try:
        backend_for(device)
    except (ImportError, RuntimeError, ValueError) as error:
        raise ConfigError(f"--device {device}: {error}. Leave it out to compute on the CPU.") from error


def _require_hdf5(target: OutputPaths) -> None:
    """Raises ConfigError for a file that holds one volume."""
    if target.written and target.output.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"-o {target.output}: volumes in time go into an HDF5 file; give a name that ends in .h5.")


@dataclass(frozen=True, eq=False)
class _Job:
    """A reconstruction: its options and data, and the channels to its user."""

    options: ReconOptions
    prepared: PreparedProjections
    sink: Sink
    clock: Clock
    stop: Stop
    warn: Warnings
    region: RegionOfRows | None = None

    @property
    def grid(self) -> Grid:
        """Of the volume; a direct method takes the voxels of a region alone."""
        grid = Grid.matching(self.prepared.geometry)
        return self.region.grid_of(grid) if self.region is not None and self.options.method.traits.direct else grid

    def say(self, text: str) -> None:
        """Tell what a slab has come to."""
        self.sink(StateEntered("slab", text, time=self.clock.now()))

    def listener(self, seconds: float | None = None) -> Callable[[Progress], None]:
        return progress_events(self.sink, self.clock, seconds)

    @contextmanager
    def refused(self, by: str = "") -> Iterator[None]:
        """Turns a ValueError into a DataError that names the file."""
        try:
            yield
        except ValueError as error:
            raise DataError(f"{self.options.source.path} cannot be reconstructed{by}: {error}") from error

    def compile_kernels(self) -> None:
        """Compile the kernels of this process, once on a machine, and report it; cluster workers compile their own.

        The time must count neither in the run nor in the estimated time left.
        """
        method, budget = self.options.method, self.options.budget
        methods = candidates_of(method) if budget is not None else (method,)
        for candidate in methods if self.options.cluster is None else ():
            with self.refused(f" by {candidate.name}"):
                warm_up(
                    candidate,
                    self.prepared.geometry,
                    device=self.options.device,
                    on_kernel=compilation_events(self.sink, self.clock),
                )

    def run(self, method: Method, control: RunControl) -> Reconstruction:
        """Run a method, with views held out if it takes any, until it ends or is stopped."""
        return self.run_on(method, self.prepared, self.grid, control)

    def run_on(
        self,
        method: Method,
        prepared: PreparedProjections,
        grid: Grid,
        control: RunControl,
        reconstruct: Callable[..., Reconstruction] = recon.reconstruct,
    ) -> Reconstruction:
        """Run a method on these views."""
        data, geometry = prepared.projections.data, prepared.geometry
        held_out: Sequence[int] = ()
        if method.traits.held_out:
            data, geometry, held_out = with_held_out(data, geometry, prepared.held_out)
        # Rays that weigh nothing were filled on disk, as a direct method does it.
        filled = method.traits.direct and prepared.on_disk
        weights = None if filled else prepared.ray_weights(len(held_out))
        control = replace(control, should_stop=self.stop, now=self.clock.now)
        with self.refused(f" by {method.name}"):
            return reconstruct(
                data, geometry, method, grid=grid, seed=self.options.seed, device=self.options.device,
                use=DataUse(weights, held_out, prepared.emission, prepared.times), control=control,
            )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Done:
    """A reconstruction, what was chosen, the views that it used, and how much coarser their pixels are."""

    made: Reconstruction
    chosen: str
    prepared: PreparedProjections
    factor: int = 1


def _volume(job: _Job, slabs: Sequence[Slab], decided: Decisions) -> _Done:
    """Reconstruct by the options: within a budget, in slabs, or at once."""
    prepared = job.prepared
    if job.options.budget is not None:
        return _within_budget(job, job.options.budget)
    if not slabs:
        return _Done(*_at_once(job, decided), prepared)
    made, chosen = _by_slabs(job, slabs, decided)
    if job.options.method.traits.direct and prepared.view_weights is not None:
        # For the record: FBP takes all rays alike, and so do its figures.
        made = replace(made, settings={**made.settings, "view_weights": prepared.view_weights})
        prepared = replace(prepared, view_weights=None)
    return _Done(made, chosen, prepared)


def _recorded(result: Reconstruction, early: bool, settings: Mapping[str, Any] | None = None) -> Reconstruction:
    """The result with `settings`, and whether it ended early, for the record; without what only a next run needs."""
    ended = {"ended_early": True} if early else {}
    return replace(result, settings={**result.settings, **(settings or {}), **ended}, checkpoint=None)


def _with_error_bars(job: _Job, made: Reconstruction, slabs: Sequence[Slab], decided: Decisions) -> Reconstruction:
    """The volume with the standard deviation of each voxel; without it, and with a warning, where it was stopped."""
    if "ended_early" in made.settings:
        job.warn("The error bars were left out, as the reconstruction was stopped.")
        return made
    message = "The volume is there; its error bars follow. Ctrl-C leaves them out."
    job.sink(StateEntered("error_bars", message, time=job.clock.now()))
    method = made_by(job.options.method_for(job.prepared.geometry), made.method)
    control = RunControl(job.stop, job.listener(), now=job.clock.now)
    given = made.volume, method, job.prepared, job.options

    why = "as they were stopped"
    try:
        if slabs:
            deviation = deviation_by_slabs(*given, slabs, decided.made, control, job.say)
        else:
            deviation = deviation_of(*given, decided.made, control)
    except ValueError as error:  # hours may be in the volume
        deviation, why = None, str(error)
    if deviation is None:
        job.warn(f"The error bars were left out: {why}. The volume is whole.")
        return made
    factors = method_on_voxels(method, decided.made).traits.error_bars
    assert factors is not None
    settings = dict(zip(("error_bars_spread", "error_bars_gradient"), factors, strict=True))
    return replace(made, deviation=deviation, settings={**made.settings, **settings})


def _at_once(job: _Job, decided: Decisions) -> tuple[Reconstruction, str]:
    """Run a method on the whole volume; save checkpoints and continue from one if asked to. Then what was chosen."""
    options, prepared, checkpoints = job.options, job.prepared, job.options.checkpoints
    method = options.method_for(prepared.geometry)
    origin, resume, steps = {}, None, 0
    if checkpoints.wanted:
        assert isinstance(method, CheckpointedMethod)  # other methods were refused
        settings, others = method.made_by
        origin, steps = origin_of(prepared, settings, {"seed": options.seed, **others}), method.planned_steps or 0
        resume = checkpoints.begin(origin, steps, job.warn)
    lost = ""  # why the last checkpoint was left out

    def keep(state: Mapping[str, NDArray[Any]]) -> None:
        nonlocal lost
        lost = checkpoints.write(origin, steps, job.warn, state)

    control = RunControl(
        on_progress=job.listener(getattr(method, "seconds", None)),
        on_checkpoint=None if checkpoints.path is None else keep,
        resume=resume,
        decide=decided if options.uncertainty else None,
    )
    result = job.run(method, control)
    if result.checkpoint is not None:
        keep(result.checkpoint)
    chosen, started_from = _chosen(result), int(result.settings.get("gaussians_at_start", 0))
    asked = getattr(method, "gaussians", None) if options.quality is None else None
    if options.quality is not None:
        chosen = f"{options.quality}: {getattr(method, 'steps', None)} steps from {started_from} Gaussians"
    if isinstance(asked, int) and resume is None and started_from < asked:
        job.warn(f"The fit started from {started_from} Gaussians, not from {asked}: the sample has no room for more.")
    if method.traits.held_out:
        result = replace(result, settings={k: v for k, v in result.settings.items() if k != "held_out"})
    reached, planned = (result.history[-1].step, result.history[-1].steps) if result.history else (0, 0)
    # The sweeps of a finish, and the factors of volumes in time, follow the last step, and can be stopped as well.
    finishes = method.traits.in_time or (isinstance(method, FitMethod) and method.finish_sweeps > 0)
    early = job.stop.stopped if finishes else job.stop.cut(reached, planned)
    resumed = {} if checkpoints.resume is None else {"resumed_from": str(checkpoints.resume)}
    return _recorded(result, early, resumed | ({"checkpoint_lost": lost} if lost else {})), chosen


def _by_slabs(job: _Job, slabs: Sequence[Slab], decided: Decisions) -> tuple[Reconstruction, str]:
    """Run a method slab by slab. Then what was chosen."""
    options = replace(job.options, method=job.options.method_for(job.prepared.geometry))
    control = RunControl(job.stop, job.listener(), now=job.clock.now, decide=decided)

    with connected(options.cluster) if options.cluster is not None else nullcontext() as cluster:
        workers = None
        if cluster is not None:
            workers = SlabWorkers(cluster.workers, partial(job.run_on, reconstruct=cluster.reconstruct))
        result = in_slabs(job.run_on, job.prepared, options, slabs, control, job.say, job.warn, workers)
    return _recorded(result, job.stop.stopped), _chosen(result)


def _chosen(result: Reconstruction) -> str:
    """The chosen method and the reason, if a method chose; otherwise empty."""
    because = result.settings.get("chosen_because")
    return "" if because is None else f"{result.method}: {because}"


def _within_budget(job: _Job, budget: float) -> _Done:
    """Reconstruct within `budget` s, from pixels that may be joined."""
    methods, largest = candidates_of(job.options.method), None if job.region is None else 1
    control = RunControl(job.stop, job.listener(budget), now=job.clock.now)
    with job.refused():
        done = within(budget, job.prepared, methods, job.options.seed, control, job.warn, largest)
    made = _recorded(replace(done.result, seconds=done.seconds), job.stop.stopped, done.settings(budget))
    return _Done(made, done.summary(budget), done.prepared, done.choice.binning)
