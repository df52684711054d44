"""The data that all trials of a scan share, and one trial in a separate process, whose peak memory is the trial's.

`python -m beamline.features.trials.worker FOLDER` reads the data and the job in the folder, and prints the result as
JSON. Its stdin is a pipe that nothing is written to: it ends with the parent process, and so does this one.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter
from scipy import ndimage
from scipy.special import logsumexp

from beamline.core.errors import DataError
from beamline.core.files import named_on_failure
from beamline.core.machine import peak_memory, reset_peak_memory
from beamline.core.process import at_end_of
from beamline.features.trials.trial import Trial
from beamline.features.trials.view_choices import ViewChoice
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.run import binned, run_on
from recon.assess import metrics
from recon.base.arrays import F32
from recon.base.geometry import Geometry, arrays_of, geometry_of_arrays
from recon.base.method import Reconstruction, RunControl, SampleRadius
from recon.base.views import parse_views
from recon.base.volume import Grid, Volume
from recon.judgement import judge
from recon.prep.correct import Projections
from recon.warm_up import warm_up

DATA, VOLUME = "data", "volume.npy"
"""Files of a folder of trials: a folder with the `TrialData`, and the volume [z, y, x] of the last trial."""
_JUDGED = "psnr", "ssim3d", "residual_held_out"
_JOB = "job.json"
_SMALL = 4096  # bytes of a file that is read at once


@dataclass(frozen=True, eq=False)
class TrialData:
    """What every trial of a scan shares.

    Attributes:
        prepared: the views that may be used, and those that no trial uses as its views held out, without what the
            monitor says of views: trials are compared by all rays with the same weight.
        truth: the volume [z, y, x] on Grid.matching(geometry).
        references: volumes on the same grid that trials are compared with, in addition to the truth, by method.
        regions: int8 [z, y, x], mask of dense and empty regions, see `metrics.kmeans_mask`; None without contrast.
    """

    prepared: PreparedProjections
    truth: F32 | None
    references: Mapping[str, F32] = field(default_factory=dict)
    regions: NDArray[np.int8] | None = None

    @property
    def geometry(self) -> Geometry:
        """Geometry of the views that may be used."""
        return self.prepared.geometry

    def save(self, folder: Path) -> None:
        """Write each array, number and word to a .npy file of a new folder, without how the views were prepared.

        Raises:
            DataError: the disk did not take it.
        """
        views = self.prepared
        parts: dict[str, Any] = {"data": self, "prepared": views, "projections": views.projections}
        if isinstance(views.sample_radius, SampleRadius):
            parts["sample"] = views.sample_radius
        values = {f"{part}.{each.name}": getattr(of, each.name) for part, of in parts.items() for each in fields(of)}
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
    def load(cls, folder: Path) -> Self:
        """What `save` and `add_references` wrote; large arrays stay in their files until they are used."""

        def arrays(part: str) -> dict[str, Any]:
            return {
                path.stem.partition(".")[2]: np.load(path, "r" if path.stat().st_size > _SMALL else None)
                for path in folder.glob(f"{part}.*.npy")
            }

        def values(part: str) -> dict[str, Any]:
            return {name: each if each.ndim else each.item() for name, each in arrays(part).items()}

        of_views, held, sample = values("prepared"), arrays("held_out"), values("sample")
        if sample:
            of_views["sample_radius"] = SampleRadius(**sample)
        prepared = PreparedProjections(
            Projections(**values("projections")),
            geometry_of_arrays(arrays("geometry")),
            axis=None,
            held_out=(held["lines"], geometry_of_arrays(arrays("unseen"))) if held else None,
            **of_views,
        )
        return cls(prepared, **{"truth": None, **values("data")}, references=arrays("reference"))


def add_references(folder: Path, volumes: Mapping[str, F32], regions: NDArray[np.int8] | None) -> None:
    """Add volumes by method, and regions, to a folder of `TrialData`; DataError: the disk did not take them."""
    for method, volume in volumes.items():
        write_array(folder / f"reference.{method}.npy", volume)
    if regions is not None:
        write_array(folder / "data.regions.npy", regions)


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write a .npy file. `np.save` of a path loses the last 4 kB where the disk is full, and says nothing.

    Raises:
        DataError: the disk did not take it.
    """
    with named_on_failure(path), path.open("wb") as file:
        np.save(SimpleNamespace(write=file.write), array, allow_pickle=False)


@dataclass(frozen=True)
class TrialJob:
    """A trial to run in a separate process; `keep`: its volume is written to `VOLUME`."""

    trial: Trial
    seed: int
    keep: bool

    def save(self, folder: Path) -> None:
        """Write the job into a folder of trials. DataError: the disk did not take it."""
        with named_on_failure(folder / _JOB):
            (folder / _JOB).write_bytes(_JOBS.dump_json(self))

    @staticmethod
    def load(folder: Path) -> TrialJob:
        """The job in a folder of trials."""
        return _JOBS.validate_json((folder / _JOB).read_bytes())


_JOBS = TypeAdapter(TrialJob)


def averaged(prepared: PreparedProjections, choice: ViewChoice) -> PreparedProjections:
    """The views of a row of a study, each the mean of a window of views.

    A longer exposure adds light, so the transmissions are averaged, -log(mean(exp(-p))), not the logarithms. A ray
    weighs as the least of its window.
    """
    groups = np.array(choice.groups)
    middle = prepared.of_views(groups[:, choice.window // 2])
    if choice.window == 1:
        return middle
    angles = prepared.geometry.angles[groups].mean(axis=1)
    angles.setflags(write=False)
    geometry, whole = replace(middle.geometry, angles=angles), prepared.projections
    weights: F32 | None = whole.weights
    lines = np.stack([math.log(choice.window) - logsumexp(-whole.data[group], axis=0) for group in groups])
    weights = None if weights is None else np.stack([weights[group].min(axis=0) for group in groups])
    means = replace(middle.projections, data=lines, weights=weights)
    return replace(middle, projections=means, geometry=geometry)


def run(
    trial: Trial,
    data: TrialData,
    seed: int,
    now: Callable[[], float] = time.perf_counter,
    cpu: Callable[[], float] = time.process_time,
) -> tuple[dict[str, Any], F32]:
    """Make a trial's reconstruction and measure it: the fields of an Outcome, and the volume [z, y, x].

    Raises:
        ValueError: the reconstruction refuses these settings.
    """
    prepared = _views_of(trial, data)
    grid = Grid.matching(data.geometry)
    warm_up(trial.build(), data.geometry)  # so that compilation is in no trial's time
    reset_peak_memory()
    before = cpu()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", UserWarning)
        result = _reconstruct(trial, prepared, grid, seed, now)
    volume = on_grid(result.volume, grid).data
    cpu_seconds, peak = cpu() - before, peak_memory()  # before measuring, which has needs of its own
    figures, squared = measured(trial.method, volume, data, grid)
    return {
        "seconds": result.seconds,
        "cpu_seconds": cpu_seconds,
        "peak_bytes": peak,
        "metrics": {name: float(value) for name, value in figures.items()},
        "gaussians": None if result.gaussians is None else result.gaussians.n,
        "squared_residuals": squared,
        "message": "; ".join(dict.fromkeys(str(one.message) for one in warned)),
    }, volume


def _views_of(trial: Trial, data: TrialData) -> PreparedProjections:
    if trial.choice is None:
        angles, period = data.geometry.angles, data.geometry.period
        return data.prepared.of_views(parse_views(f"fixed:{trial.views}", angles, period=period))
    return averaged(data.prepared, trial.choice)


def measured(method: str, volume: F32, data: TrialData, grid: Grid) -> tuple[dict[str, float], list[float]]:
    """Figures of the volume [z, y, x], and the squared residual of each view held out."""
    made, truth = Volume(volume, grid), None if data.truth is None else Volume(data.truth, grid)
    judged = judge(made, data.prepared.views, truth, held_out=data.prepared.views_held_out)
    figures = {name: value for name, value in judged.figures.items() if name in _JUDGED}
    if (reference := data.references.get(method)) is not None:
        figures["psnr_all"] = metrics.psnr(reference, volume)
        figures["ssim_all"] = metrics.ssim3d(reference, volume)
    if data.regions is not None:
        figures["snr"], figures["cnr"] = metrics.snr_cnr(metrics.sampled(volume), data.regions)
    return figures, [] if judged.held_out is None else judged.held_out.left.tolist()


def _reconstruct(
    trial: Trial,
    prepared: PreparedProjections,
    grid: Grid,
    seed: int,
    now: Callable[[], float] = time.perf_counter,
) -> Reconstruction:
    """The volume of a trial, as every command makes one; it ends when the trial's seconds, if any, are over.

    A model without voxels fills `grid` from binned views, too; others have one voxel a binned pixel.
    """
    method, views = trial.build(), binned(prepared, trial.binning)
    target = grid if method.traits.any_grid or trial.binning == 1 else Grid.matching(views.geometry)
    control = RunControl(now=now)
    in_time = control if trial.seconds_asked is None else control.by(now() + trial.seconds_asked)
    return run_on(method, views, target, seed, in_time)


def on_grid(volume: Volume, grid: Grid) -> Volume:
    """The volume on another grid, by linear interpolation at its voxels' centres (edge values beyond the ends)."""
    if volume.grid == grid:
        return volume
    edges = volume.grid.spacing
    scale, offset = np.divide(grid.spacing, edges), np.subtract(grid.first, volume.grid.first) / edges
    data = ndimage.affine_transform(volume.data, scale, offset, grid.shape, np.float32, order=1, mode="nearest")
    return Volume(data, grid)


def main(folder: Path) -> int:
    """Do the job in the folder, and print an event; the exit code."""
    job, code = TrialJob.load(folder), 0
    try:
        figures, volume = run(job.trial, TrialData.load(folder / DATA), job.seed)
        if job.keep:
            write_array(folder / VOLUME, volume)
        event = {"event": "result", **figures}
    except (ValueError, DataError) as error:  # DataError: the disk
        code = error.exit_code if isinstance(error, DataError) else 1
        event = {"event": "failed", "message": str(error)}
    print(json.dumps(event, allow_nan=True), flush=True)  # noqa: T201 - stdout is this process's only way out
    return code


if __name__ == "__main__":
    at_end_of(sys.stdin.fileno(), lambda: os._exit(1))
    sys.exit(main(Path(sys.argv[1])))
