"""The data that all trials of a scan share, and the process of each, which gets them through a folder."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter
from scipy.special import logsumexp

from beamline.core.errors import DataError
from beamline.core.files import named_on_failure, refuse_existing, refuse_not_utf8
from beamline.core.machine import machine
from beamline.core.process import ProcessEnd, json_object, run_to_end
from beamline.core.sinks import Warn
from beamline.features.trials.trial import Outcome, Trial, TrialTable
from beamline.features.trials.view_choices import ViewChoice
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections, hold_out
from beamline.projections.scan_statistics import Light, LightAsked, light_in
from beamline.projections.selection import Selection
from beamline.reconstruct.measure import fit_truth, read_truth
from beamline.reconstruct.scan_facts import facts_of
from beamline.storage.readers.open import SourceOptions
from recon.base.arrays import F32, F64, I64
from recon.base.empirical import ONE_IN
from recon.base.geometry import Geometry, arrays_of, geometry_of_arrays
from recon.base.method import Energies
from recon.base.volume import Grid
from recon.prep.correct import Projections
from recon.prep.counts import Emission, weighted_lines

VolumeAt = Callable[[float], F32]
"""The volume [z, y, x] that a view of this time, or of the energy of this number, shows."""
_HELD_OUT_VIEWS = 16  # at most
_SMALL = 4096  # bytes of a file that is read at once


@dataclass(frozen=True, eq=False)
class TrialData:
    """What every trial of a scan shares.

    Attributes:
        prepared: the views that may be used, those that no trial uses as its views held out, and what is known of
            both, without what the monitor says of views: trials are compared by all rays alike.
        truth: the volume [z, y, x] on Grid.matching(geometry).
        shown_held_out: [view] of those held out as `shown` of the others; None: 0.
        references: volumes on the same grid that trials are compared with, in addition to the truth, by method.
        regions: int8 [z, y, x], mask of dense and empty regions, see `metrics.kmeans_mask`; None without contrast.
    """

    prepared: PreparedProjections
    truth: F32 | None
    shown_held_out: F64 | None = None
    references: Mapping[str, F32] = field(default_factory=dict)
    regions: NDArray[np.int8] | None = None

    @property
    def geometry(self) -> Geometry:
        """Of the views that may be used."""
        return self.prepared.geometry

    @property
    def shown(self) -> F64:
        """[view] time in s, or number of the energy, of the views that may be used; 0: all show the same volume."""
        if (energies := self.prepared.energies) is not None:
            return energies.of_view.astype(np.float64)
        return np.zeros(self.geometry.n_views) if self.prepared.times is None else self.prepared.times

    def save(self, folder: Path) -> None:
        """Into a new folder: each array, number and word in a .npy file, without how the views were prepared.

        Files `reference.METHOD.npy` and `data.regions.npy` may follow.

        Raises:
            DataError: the disk did not take it.
        """
        views = self.prepared
        parts: dict[str, Any] = {
            "data": self, "prepared": views, "projections": views.projections, "emission": views.emission,
            "energies": views.energies,
        }  # fmt: skip
        values = {
            f"{part}.{each.name}": getattr(of, each.name) for part, of in parts.items() if of for each in fields(of)
        }
        values |= {f"geometry.{name}": value for name, value in arrays_of(self.geometry).items()}
        if views.held_out is not None:
            values["held_out.lines"] = views.held_out[0]
            values |= {f"unseen.{name}": value for name, value in arrays_of(views.held_out[1]).items()}
        with named_on_failure(folder):
            folder.mkdir()
        for name, value in values.items():
            if isinstance(value, np.ndarray | np.generic | str | float | int):
                write_array(folder / f"{name}.npy", np.asarray(value))

    @classmethod
    def load(cls, folder: Path) -> TrialData:
        """What `save` of the same program wrote; large arrays stay in their files until they are used."""

        def arrays(part: str) -> dict[str, Any]:
            files = folder.glob(f"{part}.*.npy")
            return {
                path.stem.partition(".")[2]: np.load(path, "r" if path.stat().st_size > _SMALL else None)
                for path in files
            }

        def of(part: str) -> dict[str, Any]:
            return {name: each if each.ndim else each.item() for name, each in arrays(part).items()}

        geometry = geometry_of_arrays(arrays("geometry"))
        prepared = PreparedProjections(
            Projections(**of("projections")),
            geometry,
            axis=None,
            held_out=(held["lines"], geometry_of_arrays(arrays("unseen"))) if (held := of("held_out")) else None,
            emission=Emission(geometry=geometry, **counted) if (counted := of("emission")) else None,
            energies=Energies(**energies) if (energies := of("energies")) else None,
            **of("prepared"),
        )
        return cls(prepared, **{"truth": None, **of("data")}, references=of("reference"))


@dataclass(frozen=True)
class ComparedScan:
    """The scan of a trade-off or a study, and what holds for all of its reconstructions.

    Attributes:
        folder: for the results; must not exist.
        methods: names in `recon.methods`; none: those that suit the comparison.
        truth: FILE or FILE:first:end to compare with.
        light: what the user knows of it; None: the dose is counted in frames.
        seconds: of each reconstruction, the same for all methods; None: they end when their work is done.
        max_seconds: wall time of the whole run, with reading, compiling and the page. A trial that would not fit into
            what is left is not begun, a running one is ended. None: no limit.
        command: that repeats this, for the record.
    """

    source: SourceOptions
    selection: Selection
    folder: Path
    methods: Sequence[str] = ()
    truth: str | None = None
    light: LightAsked | None = None
    seconds: float | None = None
    max_seconds: float | None = None
    seed: int = 0
    command: str = ""


def opened_scan(asked: ComparedScan, warn: Warn, without_truth: str = "") -> tuple[TrialData, TrialTable]:
    """Read and correct the views, after all inputs were checked; the table has no trials yet.

    Args:
        without_truth: advice how to do without views held out, which judge all trials where there is no truth; empty:
            none are held out.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    refuse_not_utf8(asked.source.path)
    refuse_existing(asked.folder)
    truth_given = None if asked.truth is None else read_truth(asked.truth)
    with asked.source.open() as source:
        light, facts = light_in(source, asked.light), dict(facts_of(source).table)
        prepared = prepare_projections(source, asked.selection, warn).without_warnings
    if without_truth and truth_given is None:
        prepared = hold_out(prepared, ONE_IN, most=_HELD_OUT_VIEWS, advice=without_truth)
    grid, truth = Grid.matching(prepared.geometry), None
    if truth_given is not None:
        truth = fit_truth(truth_given, grid, asked.selection.binning).data
    if light is not None:
        facts["light"] = "; ".join(light.in_words())
    return TrialData(prepared, truth), table_of(asked, facts, prepared, light)


def table_of(
    scan: ComparedScan, facts: Mapping[str, str], prepared: PreparedProjections, light: Light | None = None
) -> TrialTable:
    """A table without trials; `facts` are of the scan, by name, `light` of a view."""
    known = {**facts, "volume": " × ".join(map(str, Grid.matching(prepared.geometry).shape))}
    return TrialTable((), "psnr", prepared.length_unit, machine(), known, scan.command, light=light)


def averaged(prepared: PreparedProjections, choice: ViewChoice) -> PreparedProjections:
    """The views of a row of a study, each the mean of a window of views.

    A longer exposure adds light, so the transmissions are averaged, -log(mean(exp(-p))), not the logarithms. Counts
    of an emission are added. A ray weighs as the least of its window.
    """
    groups = np.array(choice.groups)
    middle = prepared.of_views(groups[:, choice.window // 2])
    if choice.window == 1 and prepared.emission is None:
        return middle
    angles = prepared.geometry.angles[groups].mean(axis=1)
    angles.setflags(write=False)
    geometry, whole = replace(middle.geometry, angles=angles), prepared.projections
    emission = None if prepared.emission is None else prepared.emission.summed(groups, geometry)
    weights: F32 | None = whole.weights
    if emission is not None:
        lines, weights = weighted_lines(emission)
    else:
        lines = np.stack([math.log(choice.window) - logsumexp(-whole.data[group], axis=0) for group in groups])
        weights = None if weights is None else np.stack([weights[group].min(axis=0) for group in groups])
    means = replace(middle.projections, data=lines, weights=weights)
    return replace(middle, projections=means, geometry=geometry, emission=emission)


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write a .npy file. `np.save` of a path loses the last 4 kB where the disk is full, and says nothing.

    Raises:
        DataError: the disk did not take it.
    """
    with named_on_failure(path), path.open("wb") as file:
        np.save(SimpleNamespace(write=file.write), array, allow_pickle=False)


def by_parts(count: int, data: TrialData, fit: Callable[[PreparedProjections], F32]) -> VolumeAt:
    """A volume of each part of the views: of each energy, or of so long, with linear change between their middles."""
    shown = data.shown
    if data.prepared.energies is None:
        edges = np.arange(count + 1) * shown.size // count
        in_order = np.argsort(shown, kind="stable")
        parts: list[I64] = [np.sort(in_order[first:stop]) for first, stop in pairwise(edges.tolist())]
    else:
        parts = [np.flatnonzero(shown == energy) for energy in range(count)]
    volumes = np.stack([fit(data.prepared.of_views(at)) for at in parts])
    middles = np.array([shown[at].mean() for at in parts])
    shares = np.eye(middles.size)  # of the volumes, linear between the middles
    return lambda view: np.tensordot(
        np.array([np.interp(view, middles, row) for row in shares], np.float32), volumes, 1
    )


DATA = "data"
"""Name of the folder with the `TrialData` that all trials read, in the folder of the results."""


@dataclass(frozen=True)
class TrialJob:
    """What a process is to do.

    Attributes:
        data: folder of `TrialData`.
        trial: to run; None: only kernels are compiled.
        keep: a .npy file for the volume [z, y, x]; None: it is measured and forgotten.
        compiled: trials whose kernels are compiled.
    """

    data: Path
    trial: Trial | None = None
    seed: int = 0
    keep: Path | None = None
    compiled: Sequence[Trial] = ()


JOB = TypeAdapter(TrialJob)
"""Reads and writes a job as JSON."""


COMMAND = (sys.executable, "-m", "beamline.features.trials.worker")


def compile_kernels(trials: Sequence[Trial], work: Path, max_seconds: float = math.inf) -> None:
    """Fill the cache of compiled kernels for these trials, so that no trial's memory includes the compiler's.

    Args:
        work: a folder with the data, `DATA`.
        max_seconds: after which it is ended; what is missing is compiled by the trials.
    """
    # a method and its settings that are words decide which kernels are compiled
    kinds = {
        (trial.method, *(value for value in trial.settings.values() if isinstance(value, str))): trial
        for trial in trials
    }
    job = TrialJob(work / DATA, compiled=tuple(kinds.values()))
    _run(job, work, max_seconds)  # a failure here comes again in a trial, which reports it


def run_trial(trial: Trial, work: Path, seed: int, max_seconds: float = math.inf, keep: Path | None = None) -> Outcome:
    """Run one trial in a process of its own, which has ended when this returns or raises.

    Args:
        work: a folder with the data, `DATA`.
        max_seconds: after which the process is killed.
        keep: a .npy file for its volume [z, y, x]; None: the volume is forgotten.

    Raises:
        DataError: the disk did not take the job or the volume: trials to come would fail, too.
    """
    event, (ending, code, reason) = _run(TrialJob(work / DATA, trial, seed, keep), work, max_seconds)
    if event.pop("event", None) == "result":
        return Outcome(trial, "done", **event)
    if ending is ProcessEnd.OUT_OF_TIME:
        return Outcome(trial, "out of time", message="ended: the time given with --max-seconds was over")
    message = event.get("message", f"its process ended with code {code}" + (f": {reason}" if reason else ""))
    if code == DataError.exit_code:
        raise DataError(message)
    return Outcome(trial, "failed", message=message)


def _run(job: TrialJob, work: Path, max_seconds: float) -> tuple[dict[str, Any], tuple[ProcessEnd, int | None, str]]:
    """The last event of a process that does the job, and how it ended, see `run_to_end`."""
    path, last = work / "job.json", dict[str, Any]()
    with named_on_failure(path):
        path.write_bytes(JOB.dump_json(job))

    def on_line(line: str) -> None:
        nonlocal last
        last = json_object(line) or last

    ended = run_to_end([*COMMAND, str(path)], work / "stderr.txt", on_line, seconds=max_seconds)
    return last, ended
