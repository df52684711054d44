"""One trial in a process of its own, so that its peak memory is its own.

`python -m beamline.features.trials.worker JOB` reads the job and its arrays, and prints the result as JSON. A job may
also be to compile what trials will need, once for all of them: compiling takes memory that would otherwise count as
the first trial's. Its stdin is a pipe that nothing is written to: when it ends, the parent process has ended, and this
one ends, too.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from beamline.core.errors import DataError
from beamline.core.machine import peak_memory, reset_peak_memory
from beamline.core.process import at_end_of
from beamline.features.trials.launch import JOB, TrialData, VolumeAt, averaged, by_parts, write_array
from beamline.features.trials.trial import Trial
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.measure import squares_left
from beamline.reconstruct.run import binned, run_on
from beamline.report.history import history_arrays, residual_curve
from recon.assess import metrics
from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.method import RunControl
from recon.base.views import parse_views
from recon.base.volume import Grid, Volume
from recon.features.trials import fourier_shell_correlation, soft_cylinder
from recon.reconstruction import Reconstruction
from recon.voxels.projector import project
from recon.voxels.resolution import ViewResolution
from recon.warm_up import warm_up


def run(
    trial: Trial,
    data: TrialData,
    seed: int,
    now: Callable[[], float] = time.perf_counter,
    cpu: Callable[[], float] = time.process_time,
    keep: Path | None = None,
) -> dict[str, Any]:
    """Make a trial's reconstruction and measure it; the fields of an Outcome.

    Args:
        keep: a .npy file to leave the volume in; None: it is measured and forgotten.

    Raises:
        ValueError: the reconstruction refuses these settings.
        DataError: the disk did not take the volume.
    """
    if trial.choice is not None:
        prepared = averaged(replace(data.prepared, held_out=None), trial.choice)
        if arc := trial.choice.arc:
            views = prepared.geometry
            prepared = replace(prepared, geometry=views.seen_with(replace(views.width, arc=arc), views.skew))
    else:
        angles, period = data.geometry.angles, data.geometry.period
        prepared = data.prepared.of_views(parse_views(f"fixed:{trial.views}", angles, period=period))
    grid, result, judged, warned = Grid.matching(data.geometry), None, None, list[warnings.WarningMessage]()
    warm_up(trial.build(), data.geometry)  # so that compilation is in no trial's time
    reset_peak_memory()
    before, began = cpu(), now()
    if trial.parts > 1:
        volume_at = by_parts(trial.parts, data, lambda part: _alone(trial, part, grid, seed))
    else:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always", UserWarning)
            result = reconstruct(trial, prepared, grid, seed, now)
        one = on_grid(result.volume, grid).data
        volume_at = result.at or (lambda view: one)
        judged = residual_curve(history_arrays(result.history))
    cpu_seconds, seconds = cpu() - before, now() - began if result is None else result.seconds
    peak = peak_memory()  # before measuring, which has needs of its own
    figures, squared = measured(trial.method, volume_at, data, grid, keep)
    if trial.halves and trial.views >= 4:
        figures["resolution"] = half_set_resolution(trial, prepared, grid, seed)
    return {
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "peak_bytes": peak,
        "metrics": {name: float(value) for name, value in figures.items()},
        "gaussians": None if result is None or result.gaussians is None else result.gaussians.n,
        "squared_residuals": squared,
        "curve": [] if judged is None else np.transpose(judged.decibels).tolist(),
        "curve_of": "" if judged is None else judged.views,
        "reached": "" if result is None else reached(result),
        "message": "; ".join(dict.fromkeys(str(one.message) for one in warned)),
    }


def measured(
    method: str, volume_at: VolumeAt, data: TrialData, grid: Grid, keep: Path | None
) -> tuple[dict[str, float], list[float]]:
    """Figures of the volume, and the squared residual of each view held out. `keep` gets what the middle view shows."""
    n, figures, squared = data.geometry.n_views, dict[str, float](), list[float]()
    middle = volume_at(float(np.sort(data.shown)[n // 2]))
    if keep is not None:
        write_array(keep, middle)
    if data.truth is not None:
        figures = {"psnr": metrics.psnr(data.truth, middle), "ssim3d": metrics.ssim3d(data.truth, middle)}
        if data.prepared.emission is not None:
            figures |= metrics.contrast(data.truth, middle)
    if (reference := data.references.get(method)) is not None:
        figures["psnr_all"] = metrics.psnr(reference, middle)
        figures["ssim_all"] = metrics.ssim3d(reference, middle)
    if data.regions is not None:
        figures["snr"], figures["cnr"] = metrics.snr_cnr(metrics.sampled(middle), data.regions)
    if data.prepared.held_out is not None:
        unseen, geometry = data.prepared.held_out
        rays = data.prepared.ray_weights(geometry.n_views)
        of_view = np.zeros(geometry.n_views) if data.shown_held_out is None else data.shown_held_out
        left, own = squares_left(
            shown(volume_at, of_view, geometry, grid),
            unseen,
            ViewResolution.of(geometry, grid),
            None if rays is None else np.asarray(rays[n:] > 0),
        )
        if not own.any():
            raise ValueError("all held-out views are zero, so no residual can be computed")
        figures["residual_held_out"] = math.sqrt(left.sum() / own.sum())
        squared = left.tolist()
    return figures, squared


def _alone(trial: Trial, prepared: PreparedProjections, grid: Grid, seed: int) -> F32:
    """The volume [z, y, x] of these views alone, with no view held out."""
    result = reconstruct(trial, replace(prepared, held_out=None), grid, seed)
    return on_grid(result.volume, grid).data


def shown(volume_at: VolumeAt, of_view: F64, geometry: Geometry, grid: Grid) -> F32:
    """Line integrals [view, row, col] of the volume that each view shows, by its time or the number of its energy."""
    lines = np.empty((geometry.n_views, *geometry.detector_shape), np.float32)
    for key in np.unique(of_view):
        at = np.flatnonzero(of_view == key)
        lines[at] = project(Volume(volume_at(float(key)), grid), geometry.select(at))
    return lines


def half_set_resolution(trial: Trial, prepared: PreparedProjections, grid: Grid, seed: int) -> float:
    """Full period (mm, half-bit) to which reconstructions from the even and from the odd views agree."""
    geometry = prepared.geometry
    order = np.argsort(np.mod(geometry.angles, geometry.period), kind="stable")
    even, odd = (_alone(trial, prepared.of_views(np.sort(order[n::2])), grid, seed) for n in (0, 1))
    return fourier_shell_correlation(even, odd, grid.spacing, soft_cylinder(grid.shape)).resolution_mm


def reconstruct(
    trial: Trial,
    prepared: PreparedProjections,
    grid: Grid,
    seed: int,
    now: Callable[[], float] = time.perf_counter,
) -> Reconstruction:
    """The volume of a trial, as every command makes one; it ends when the trial's seconds, if any, are over.

    A model without voxels fills `grid` from binned views all the same; others have one voxel a binned pixel.
    """
    method, views = trial.build(), binned(prepared, trial.binning)
    target = grid if method.traits.any_grid or trial.binning == 1 else Grid.matching(views.geometry)
    control = RunControl(now=now)
    in_time = control if trial.seconds_asked is None else control.by(now() + trial.seconds_asked)
    return run_on(method, views, target, seed, in_time)


def reached(result: Reconstruction) -> str:
    """Steps or iterations done, and sweeps on voxels after a fit; empty for a direct method."""
    if not result.history:
        return ""
    word = next((each for each in ("iteration", "sweep") if f"{each}s" in result.settings), "step")
    done = [(result.history[-1].step, word), (result.settings.get("finish", 0), "sweep")]
    return ", ".join(f"{n} {word}{'s' * (n != 1)}" for n, word in done if n or word != "sweep")


def on_grid(volume: Volume, grid: Grid) -> Volume:
    """The volume on another grid, by linear interpolation at its voxels' centres (edge values beyond the ends)."""
    if volume.grid == grid:
        return volume
    edges = volume.grid.spacing
    scale, offset = np.divide(grid.spacing, edges), np.subtract(grid.first, volume.grid.first) / edges
    data = ndimage.affine_transform(volume.data, scale, offset, grid.shape, np.float32, order=1, mode="nearest")
    return Volume(data, grid)


def main(job: Path) -> int:
    """Do the `TrialJob` in the file `job`, and print an event; the exit code."""
    work, code = JOB.validate_json(job.read_bytes()), 0
    try:
        data = TrialData.load(work.data)
        for trial in work.compiled:
            with suppress(ValueError):  # a method that does not take these views: its own trial will say so
                warm_up(trial.build(), data.geometry)
        if work.trial is None:
            return 0
        event = {"event": "result", **run(work.trial, data, work.seed, keep=work.keep)}
    except (ValueError, DataError) as error:  # DataError: the disk
        code = error.exit_code if isinstance(error, DataError) else 1
        event = {"event": "failed", "message": str(error)}
    print(json.dumps(event), flush=True)  # noqa: T201 - stdout is this process's only way out
    return code


if __name__ == "__main__":
    at_end_of(sys.stdin.fileno(), lambda: os._exit(1))
    sys.exit(main(Path(sys.argv[1])))
