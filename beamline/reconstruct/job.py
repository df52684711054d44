"""Job: a method run on prepared views, at once, in slabs or within a budget; in every case a volume for the record."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from numpy.typing import NDArray

import recon
from beamline.core.errors import DataError
from beamline.core.events import Sink, StateEntered
from beamline.core.sinks import Warnings
from beamline.projections.held_out import with_held_out
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.budget import within
from beamline.reconstruct.checkpoints import origin_of
from beamline.reconstruct.cluster import connected
from beamline.reconstruct.error_bars import deviation_by_slabs, deviation_of, made_by
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.progress import compilation_events, progress_events
from beamline.reconstruct.region import RegionOfRows
from beamline.reconstruct.slab_run import SlabWorkers, in_slabs
from drivers.base.clock import Clock
from recon.base.decisions import Decisions
from recon.base.method import (
    CheckpointedMethod,
    DataUse,
    Method,
    Progress,
    Reconstruction,
    RunControl,
    candidates_of,
)
from recon.base.slabs import Slab
from recon.base.stop import Stop
from recon.base.volume import Grid
from recon.error_bars import method_on_voxels
from recon.splatting.fit_method import FitMethod
from recon.warm_up import warm_up


@dataclass(frozen=True, eq=False)
class Job:
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
        """Grid of the volume; of a region alone for a direct method."""
        grid = Grid.matching(self.prepared.geometry)
        return self.region.grid_of(grid) if self.region is not None and self.options.method.traits.direct else grid

    def say(self, text: str) -> None:
        """Report the progress of a slab."""
        self.sink(StateEntered("slab", text, time=self.clock.now()))

    def listener(self, seconds: float | None = None) -> Callable[[Progress], None]:
        return progress_events(self.sink, self.clock, seconds)

    @contextmanager
    def refused(self, by: str = "") -> Iterator[None]:
        """Turn a ValueError into a DataError that names the file."""
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
                use=DataUse(weights, held_out, prepared.emission, prepared.times, prepared.energies), control=control,
            )  # fmt: skip


@dataclass(frozen=True, eq=False)
class MadeVolume:
    """A reconstruction, what was chosen, the views that it used, and how much coarser their pixels are."""

    made: Reconstruction
    chosen: str
    prepared: PreparedProjections
    factor: int = 1


def volume_of(job: Job, slabs: Sequence[Slab], decided: Decisions) -> MadeVolume:
    """Reconstruct by the options: within a budget, in slabs, or at once."""
    prepared = job.prepared
    if job.options.budget is not None:
        return _within_budget(job, job.options.budget)
    if not slabs:
        return MadeVolume(*_at_once(job, decided), prepared)
    made, chosen = _by_slabs(job, slabs, decided)
    if job.options.method.traits.direct and prepared.view_weights is not None:
        # For the record: FBP takes all rays alike, and so do its figures.
        made = replace(made, settings={**made.settings, "view_weights": prepared.view_weights})
        prepared = replace(prepared, view_weights=None)
    return MadeVolume(made, chosen, prepared)


def _recorded(result: Reconstruction, early: bool, settings: Mapping[str, Any] | None = None) -> Reconstruction:
    """The result with `settings`, and whether it ended early, for the record; without what only a next run needs."""
    ended = {"ended_early": True} if early else {}
    return replace(result, settings={**result.settings, **(settings or {}), **ended}, checkpoint=None)


def with_error_bars(job: Job, made: Reconstruction, slabs: Sequence[Slab], decided: Decisions) -> Reconstruction:
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


def _at_once(job: Job, decided: Decisions) -> tuple[Reconstruction, str]:
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
    # The sweeps of a finish, and the factors of several volumes, follow the last step, and can be stopped as well.
    finishes = method.traits.several or (isinstance(method, FitMethod) and method.finish_sweeps > 0)
    early = job.stop.stopped if finishes else job.stop.cut(reached, planned)
    resumed = {} if checkpoints.resume is None else {"resumed_from": str(checkpoints.resume)}
    return _recorded(result, early, resumed | ({"checkpoint_lost": lost} if lost else {})), chosen


def _by_slabs(job: Job, slabs: Sequence[Slab], decided: Decisions) -> tuple[Reconstruction, str]:
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


def _within_budget(job: Job, budget: float) -> MadeVolume:
    """Reconstruct within `budget` s, from pixels that may be joined."""
    methods, largest = candidates_of(job.options.method), None if job.region is None else 1
    control = RunControl(job.stop, job.listener(budget), now=job.clock.now)
    with job.refused():
        done = within(budget, job.prepared, methods, job.options.seed, control, job.warn, largest)
    made = _recorded(replace(done.result, seconds=done.seconds), job.stop.stopped, done.settings(budget))
    return MadeVolume(made, done.summary(budget), done.prepared, done.choice.binning)
