"""Reconstructs a volume slab by slab into a partial volume, which a later call can continue."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from math import nan
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError, ScanStopped
from beamline.core.files import remove
from beamline.core.installed import version
from beamline.core.sinks import Warn
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.checkpoints import origin_of, refuse_other
from beamline.reconstruct.options import ReconOptions
from beamline.storage.recon_record import ReconRecord, Value
from beamline.storage.writers.partial_volume import PartialVolume, create_partial, open_partial
from recon.base.decisions import Decisions
from recon.base.method import SWEEPS_OF_TRIALS, Ending, Method, Progress, Reconstruction, RunControl
from recon.base.slabs import Slab, height_of, part_of
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.voxels.methods import FistaTv

_LOOKED_AT = 8  # number of views by which the rows with most material are found
_WEIGHED = 16  # number of rows whose weights are made together

_LOOK = 0.5  # s between two checks of the slabs that are being made

T = TypeVar("T")
RunMethod = Callable[[Method, Views, Grid, RunControl], Reconstruction]  # reconstructs views on a grid


@dataclass(frozen=True)
class SlabWorkers:
    """Reconstructs `count` slabs at a time, each by `run` in its own thread."""

    count: int
    run: RunMethod


def in_slabs(
    run: RunMethod,
    prepared: PreparedProjections,
    options: ReconOptions,
    slabs: Sequence[Slab],
    control: RunControl,
    say: Callable[[str], None],
    warn: Warn,
    workers: SlabWorkers | None = None,
) -> Reconstruction:
    """Reconstruct a volume on disk, slab by slab. For a partial volume, reconstruct only the missing slabs.

    The slab with the most material comes first. The other slabs use the decisions that were made for it, so that all
    slabs fit together. Neighbouring slabs overlap and are blended. Each slab depends only on the data and on the first
    slab, so a volume that was stopped and resumed is the same, bit by bit.

    Args:
        control: control of all slabs together; if it has `decide`, this gets the decisions that the slabs use.
        warn: function that gets a sentence on slices that were reconstructed with another method.
        workers: workers that reconstruct all slabs except the first, several at a time; only this thread writes.

    Raises:
        DataError: the projections are zero everywhere, or the partial volume belongs to other data or options.
    """
    job = _SlabJob(run, prepared, options, slabs, control, say, begin=control.now())
    partial = job.resumed()
    missing = [n for n in busiest_first(prepared, job.grid, slabs) if partial is None or not partial.has(n)]
    if partial is None:
        partial, missing = job.begun(missing)
    decided = partial.kept["decided"]
    if workers is None:
        for n in missing:
            job.announce(n)
            decide = Decisions(options.seed, decided)
            _add(partial, n, *job.made(n, run, decide, partial.n_slices_done, first=False), warn)
    else:
        slabs_done = _as_they_come(
            lambda n: job.made(n, workers.run, Decisions(options.seed, decided), 0, first=False), missing, workers.count
        )
        for n, (result, remark) in slabs_done:
            _add(partial, n, result, remark, warn)
            job.tell(partial.n_slices_done)
    if control.decide is not None:
        control.decide.made.update(decided)
    return _finished(partial, job.grid, options, control.now() - job.begin)


@dataclass(frozen=True, eq=False)
class _SlabJob:
    """The slabs of one volume. For the arguments see `in_slabs`."""

    run: RunMethod
    prepared: PreparedProjections
    options: ReconOptions
    slabs: Sequence[Slab]
    control: RunControl
    say: Callable[[str], None]
    begin: float

    @property
    def grid(self) -> Grid:
        return Grid.matching(self.prepared.geometry)

    def announce(self, n: int) -> None:
        own = self.slabs[n].own
        number = n + 1
        last_slice = own.stop - 1
        self.say(f"Slab {number} of {len(self.slabs)}: slices {own.start} to {last_slice}.")

    def tell(self, done: int) -> None:
        """Report the number of finished slices."""
        slices = self.grid.shape[0]
        self.say(f"{done} of {slices} slices are done.")
        if (listen := self.control.on_progress) is not None:
            seconds, views = self.control.now() - self.begin, self.prepared.geometry.n_views
            listen(Progress(done, slices, seconds, nan, nan, 0, views, unit="slices"))

    def resumed(self) -> PartialVolume | None:
        """The partial volume to complete; None: a new one is needed. Raises DataError if it belongs to another
        reconstruction.
        """
        if (path := self.options.partial) is None:
            return None
        partial = open_partial(path)
        refuse_other(path, _provenance(self.prepared, self.options), partial.made_from, "reconstruction")
        self.say(f"{partial.n_slices_done} of {self.grid.shape[0]} slices are done.")
        return partial

    def begun(self, numbers: Sequence[int]) -> tuple[PartialVolume, list[int]]:
        """Reconstruct slabs until one contains material; return the new partial volume and the remaining slabs.

        Raises:
            DataError: no slab contains material.
        """
        for place, n in enumerate(numbers):
            self.announce(n)
            decide = Decisions(self.options.seed)
            slab, _ = self.made(n, self.run, decide, 0, first=True)
            if slab is None:
                continue
            record = _record(self.prepared, self.options, self.grid, self.begin, slab.change is not None)
            made_from = _provenance(self.prepared, self.options)
            path, decisions = self.options.partial_path, _kept(slab, decide)
            partial = create_partial(path, record, self.slabs, made_from, decisions)
            partial.add(n, slab.volume.data, change=_change(slab))
            return partial, list(numbers[place + 1 :])
        raise DataError("There is no sample in the beam: the projections are zero everywhere.")

    def made(
        self, n: int, by: RunMethod, decide: Decisions, done: int, *, first: bool
    ) -> tuple[Reconstruction | None, str]:
        """The slab (None if all projections are zero), and a remark: a sentence if another method was used, otherwise
        "".

        Args:
            done: number of slices that are finished before this slab.
            first: True for the first of all slabs, whose decisions the other slabs use.
        """
        slab, slices, method = self.slabs[n], self.grid.shape[0], self.options.method
        listen = _of_all(self.control, self.begin, done, slab, slices)
        control = replace(self.control, decide=decide, on_progress=listen)
        rows, geometry, box = part_of(self.prepared.geometry, self.grid, slab.slices)
        part = self.prepared.of_rows(rows, geometry).views
        if not part.seen.data.any():
            return None, ""
        in_all = sum(each.slices.stop - each.slices.start for each in self.slabs)
        try:
            height = slab.slices.stop - slab.slices.start
            method = method.for_part(height / slices, height / in_all)
            return by(method.at_height(height_of(rows, self.prepared.geometry)), part, box, control), ""
        except DataError as error:
            # A fit needs material in which to place Gaussians; a slab of air has none. A voxel method does not need
            # material.
            if first or not method.needs_matter:
                raise
            remark = _with_another_method(slab, FistaTv.name, str(error))
            return by(FistaTv(half_voxels=False), part, box, control), remark  # the plan has no memory for half voxels


def _as_they_come(make: Callable[[int], T], numbers: Sequence[int], at_a_time: int) -> Iterator[tuple[int, T]]:
    """Yield the number of each slab with the result of `make`. At most `at_a_time` slabs are being made, or wait until
    the caller takes them.
    """
    pool, ahead, under_way = ThreadPoolExecutor(at_a_time), list(numbers), dict[Future[T], int]()
    try:
        while ahead or under_way:
            while ahead and len(under_way) < at_a_time:
                n = ahead.pop(0)
                under_way[pool.submit(make, n)] = n
            # On Windows, Ctrl-C does not interrupt a wait without a time limit.
            for task in wait(under_way, _LOOK, FIRST_COMPLETED).done:
                yield under_way.pop(task), task.result()
    finally:
        # A thread that has returned its slab keeps the partial volume, and the lock on it, until the thread ends.
        pool.shutdown(wait=not under_way, cancel_futures=True)


def _add(partial: PartialVolume, n: int, result: Reconstruction | None, remark: str, warn: Warn) -> None:
    """Add a slab. `warn` gets its remark, or a sentence if its method is not that of the first slab."""
    if not remark and result is not None and result.method != partial.kept["method"]:
        remark = _with_another_method(partial.slabs[n], result.method, result.chosen)
    if result is None:
        partial.add(n, None)
    else:
        partial.add(n, result.volume.data, change=_change(result), otherwise=bool(remark))
    if remark:
        warn(remark)


def _change(result: Reconstruction) -> NDArray[np.float32] | None:
    """The voxels of the change since a reference; None: the slab was reconstructed without a reference."""
    return None if result.change is None else result.change.data


def _with_another_method(slab: Slab, method: str, why: str) -> str:
    return (
        f"Slices {slab.own.start} to {slab.own.stop - 1} were reconstructed with {method}, not with the method of "
        f"the first slab: {why}"
    )


@contextmanager
def keeping(path: Path) -> Iterator[None]:
    """A context manager that removes the partial volume at `path` on success, and keeps it otherwise.

    Raises:
        ScanStopped: replaces KeyboardInterrupt if there are finished slabs, from which a later call can continue.
    """
    try:
        yield
    except KeyboardInterrupt as error:
        if not path.is_file():
            raise
        raise ScanStopped(
            f"The reconstruction was stopped. {path} has the finished slabs. To reconstruct the remaining slabs, add "
            f"--resume {path} to the same command."
        ) from error
    remove(path)


def _provenance(prepared: PreparedProjections, options: ReconOptions) -> dict[str, Value]:
    """The origin of the slabs (see `origin_of`): everything that determines them."""
    weights = hashlib.sha256()
    if options.method.weighs:
        rows = prepared.geometry.detector_shape[0]
        for first in range(0, rows, _WEIGHED):
            end = min(first + _WEIGHED, rows)
            weights_of_rows = prepared.of_rows(slice(first, end), prepared.geometry.rows(first, end)).views.seen.weights
            if weights_of_rows is not None:
                weights.update(np.ascontiguousarray(weights_of_rows[...]).data)
    others: dict[str, Value] = {
        "method": options.method.name, "seed": options.seed, "device": options.device, "program": version(),
    }  # fmt: skip
    return {**origin_of(prepared, options.method, others), "weights": weights.hexdigest()}


def _record(
    prepared: PreparedProjections, options: ReconOptions, grid: Grid, now: float, with_change: bool
) -> ReconRecord:
    """The record of a partial volume, without voxels. `with_change`: the file also gets the change since a
    reference."""
    path, no_voxels = Path(options.source.path), np.broadcast_to(np.float32(0), grid.shape)
    return ReconRecord(
        volume=prepared.with_true_heights(Volume(no_voxels, grid)),
        change=no_voxels if with_change else None,
        length_unit=prepared.origin.length_unit,
        raw_file=str(path.resolve()),
        title=f"Partial reconstruction of {path.name}",
        sample="not stated",
        time=now,
        parameters={"method": options.method.name, "command": options.command},
    )


def _kept(first: Reconstruction, decide: Decisions) -> dict[str, Any]:
    """The parts of the first slab's result that the other slabs and the whole result need."""
    return {
        "decided": decide.made,
        "method": first.method,
        "settings": dict(first.settings),
        "chosen": first.chosen,
        "history": [astuple(progress) for progress in first.history],
    }


def _finished(partial: PartialVolume, grid: Grid, options: ReconOptions, seconds: float) -> Reconstruction:
    """The result, after all slabs are finished."""
    stored = partial.kept
    settings = {**stored["settings"], "slabs": len(partial.slabs), "slab_halo": options.method.halo}
    if others := partial.made_otherwise:
        settings["slices_by_another_method"] = np.array(others)
    history = tuple(Progress(*values) for values in stored["history"])
    return Reconstruction(
        Volume(partial.volume, grid), settings, history, method=stored["method"], seconds=seconds,
        chosen=stored["chosen"], change=None if partial.change is None else Volume(partial.change, grid),
        ending=Ending(resumed_from="" if options.partial is None else str(options.partial)),
    )  # fmt: skip


def busiest_first(prepared: PreparedProjections, grid: Grid, slabs: Sequence[Slab]) -> list[int]:
    """The numbers of the slabs. The first number is that of the slab whose rows show the most material."""
    data = prepared.seen.data
    sampled, rows = (
        data[:: max(1, len(data) // _LOOKED_AT)],
        [part_of(prepared.geometry, grid, s.own)[0] for s in slabs],
    )
    absorption = [sum(float(np.abs(view[part]).sum(dtype=np.float64)) for view in sampled) for part in rows]
    best = int(np.argmax(absorption))
    return [best, *(n for n in range(len(slabs)) if n != best)]


def _of_all(control: RunControl, begin: float, done: int, slab: Slab, slices: int) -> Callable[[Progress], None] | None:
    """A listener to one slab that reports the progress of all slices. `done` slices were finished before this slab."""
    listen = control.on_progress
    if listen is None:
        return None

    reached = done

    def watch(progress: Progress) -> None:
        nonlocal reached
        share = (
            0.0 if progress.unit.startswith(SWEEPS_OF_TRIALS) or not progress.steps else progress.step / progress.steps
        )
        steps = done + round((slab.own.stop - slab.own.start) * share)
        reached = max(reached, steps)  # the voxel refinement after a fit counts from its own beginning
        listen(replace(progress, step=reached, steps=slices, seconds=control.now() - begin, unit="slices"))

    return watch
