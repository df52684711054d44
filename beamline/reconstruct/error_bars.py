"""Error bars of a finished volume: at once, or slab by slab beside a volume on disk."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from beamline.core.errors import ConfigError
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.slab_run import busiest_first
from beamline.storage.scratch import scratch_array
from beamline.storage.writers.recon_file import SUFFIXES
from recon.base.geometry import Geometry
from recon.base.method import DataUse, Method, ReconProblem, RunControl, candidates_of
from recon.base.volume import Grid, Slab, Volume, part_of, slabs_of
from recon.error_bars import HALO, LEAST_VIEWS, ErrorBars, error_bars
from recon.methods import with_trait
from recon.splatting.fit_method import FitMethod

Made = Mapping[str, Sequence[Any]]


def refuse_impossible(options: ReconOptions) -> None:
    """Raise ConfigError before any work where error bars cannot be made or written."""
    methods = candidates_of(options.method)
    if not all(method.traits.error_bars for method in methods):
        raise ConfigError(
            f"--uncertainty is calibrated for {', '.join(with_trait('error_bars'))}, and not for "
            f"{options.method.name}: leave it out, or choose another method."
        )
    if options.target.written and options.target.output.suffix.lower() not in SUFFIXES:
        raise ConfigError(
            f"--uncertainty writes a second volume into the same file: give -o "
            f"{options.target.output.with_suffix('.h5')}, and export each of the two with --dataset."
        )


def refuse_views(method: Method, geometry: Geometry) -> None:
    """Raise ConfigError before the work where these views allow no error bars."""
    if geometry.n_views < LEAST_VIEWS:
        raise ConfigError(
            f"--uncertainty splits the views into two halves: at least {LEAST_VIEWS} views are needed, got "
            f"{geometry.n_views}. Leave it out, or take more views."
        )
    if isinstance(method, FitMethod) and method.finish_sweeps == 0:
        raise ConfigError(
            f"--uncertainty refits on voxels, and {method.name} has no finish there with --finish 0. Leave one of "
            "them out."
        )


def made_by(method: Method, name: str) -> Method:
    """The method itself, or the candidate of this name, if it chose one."""
    return {candidate.name: candidate for candidate in candidates_of(method)}.get(name, method)


def deviation_of(
    volume: Volume, method: Method, prepared: PreparedProjections, options: ReconOptions, decided: Made,
    control: RunControl,
) -> Volume | None:  # fmt: skip
    """The standard deviation of each voxel of a volume in memory; None where `control` ended it.

    Raises:
        ValueError: as `recon.error_bars.error_bars`.
    """
    bars = _bars(method, prepared, options, volume, decided, control)
    if control.stop():  # a direct method does not ask
        return None
    return None if bars is None else Volume(bars.deviation, volume.grid)


def deviation_by_slabs(
    volume: Volume,
    method: Method,
    prepared: PreparedProjections,
    options: ReconOptions,
    slabs: Sequence[Slab],
    decided: Made,
    control: RunControl,
    say: Callable[[str], None],
) -> Volume | None:
    """The same of a volume on disk, as an array on the disk of the output; None where `control` ended it.

    The slab with most matter comes first, and the others follow its decisions.
    """
    grid = Grid.matching(prepared.geometry)
    parts = slabs_of(grid.shape[0], slabs[0].own.stop, max(method.traits.halo, HALO))
    out = scratch_array(Path(options.target.output).parent, grid.shape)
    for done, n in enumerate(busiest_first(prepared, grid, parts), 1):
        slab = parts[n]
        rows, geometry, box = part_of(prepared.geometry, grid, slab.slices)
        part = prepared.of_rows(rows, geometry)
        if not part.projections.data.any():
            continue
        here = Volume(np.ascontiguousarray(volume.data[slab.slices]), box)
        bars = _bars(method, part, options, here, decided, control)
        if bars is None or control.stop():
            return None
        decided = bars.decided
        for z, share, values in zip(range(*slab.slices.indices(len(out))), slab.share, bars.deviation, strict=True):
            if share > 0:
                out[z] += share * values
        say(f"Error bars of slab {done} of {len(parts)}.")
    return Volume(out, grid)


def _bars(
    method: Method, prepared: PreparedProjections, options: ReconOptions, volume: Volume, decided: Made,
    control: RunControl,
) -> ErrorBars | None:  # fmt: skip
    # Rays that weigh nothing were filled on disk, as a direct method does it.
    weights = None if method.traits.direct and prepared.on_disk else prepared.ray_weights()
    problem = ReconProblem(
        prepared.projections.data, prepared.geometry, volume.grid, DataUse(weights), options.seed, options.device
    )
    return error_bars(method, problem, volume, decided, replace(control, decide=None))
