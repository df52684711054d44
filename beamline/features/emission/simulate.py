"""Scenes of a sample that emits, for `beamline simulate`: counts, and the activity behind them."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from beamline.cli.options import refuse_shared
from beamline.cli.terminal import Terminal, counting
from beamline.core.errors import ConfigError
from beamline.core.events import Done, Sink
from beamline.core.files import refuse_existing, remove, whole_file
from beamline.core.machine import free_memory
from beamline.core.sinks import fan_out
from beamline.core.text import size
from beamline.core.voxel_kind import VoxelKind
from beamline.scenes.request import Output, SimulateRequest
from beamline.scenes.scene_file import Truth, grid_of, open_other, write_truth
from beamline.storage import hdf5
from drivers.base.clock import SystemClock
from simulators.scenes.emission import EmissionScene, Events, events, load_emission

_BYTES_A_LINE = 120  # as measured


def run(request: SimulateRequest, output: Output, sink: Sink) -> None:
    """Simulate the scene of a request.

    Raises:
        ConfigError: it is wrong, or asked for what it does not have. DataError: a file exists or cannot be written.
    """
    scene = open_other(request.scene, request.overrides, load_emission)
    if request.explains or request.truth_bin or request.picture:
        raise ConfigError(f"{request.scene} emits: it takes no --explain, --truth-bin or --picture. Leave them out.")
    out, truth = request.out, request.truth
    refuse_shared({"--output": out, "--truth": truth})
    scene = replace(scene, lines=replace(scene.lines, views=request.views or scene.lines.views))
    wanted = {"output": out, "truth": truth}
    for path in (path for path in wanted.values() if path):
        refuse_existing(path)
    with Terminal(sys.stderr) as terminal:
        made = _emit(scene, request.seed, counting("views", fan_out(terminal, sink), SystemClock()))
    if truth:
        write_truth(truth, _truth(scene, made.scale))
        output("truth", f"{truth}  activity, {made.scale:.4g} counts per mm of line in the body")
    try:
        if out:
            _write(out, scene, made)
            output("scan", f"{out}  {len(made.counts)} views, {made.counts.sum():.4g} counts")
    except BaseException:  # Ctrl-C, too
        if truth:
            remove(truth)
        raise
    output.event(Done({name: path for name, path in wanted.items() if path}))


def _emit(scene: EmissionScene, seed: int, progress: Callable[[int, int], object]) -> Events:
    """The counts of a scene. Raises ConfigError where the memory does not hold them."""
    needed, free = _BYTES_A_LINE * scene.lines.views * math.prod(scene.lines.shape), free_memory()
    if needed > free:
        raise ConfigError(
            f"The lines take {size(needed)} of memory, {size(free)} are free. Give fewer lines, or --frames. Nothing "
            "was simulated."
        )
    return events(scene.emission, scene.lines.detector, scene.lines.angles, scene.scanner, seed, progress)


def _truth(scene: EmissionScene, scale: float) -> Truth:
    """The activity in counts per mm of line, `scale` in the body, in voxels of a line's width."""
    grid, sample = grid_of(scene.lines.detector, 1), scene.emission.activity
    activity = sample.attenuation(grid) * np.float32(scale)
    return Truth(grid, activity, sample.labels(grid), sample.names, VoxelKind.ACTIVITY)


def _write(path: Path, scene: EmissionScene, made: Events) -> None:
    """Write counts, and all that is known of them, to an HDF5 file, complete or not at all.

    Raises:
        DataError: `path` exists or cannot be written.
    """
    sets = {
        "counts": made.counts, "attenuation": made.attenuation, "normalisation": made.efficiency,
        "randoms": made.randoms, "scatter": made.scatter,
    }  # fmt: skip
    with whole_file(path) as partial, hdf5.created(partial) as file:
        group = file.create_group("emission")
        for name, values in sets.items():
            group.create_dataset(name, data=values, chunks=(1, *values.shape[1:]), compression="gzip", fletcher32=True)
        group["angles"], group["pixel_size"] = np.degrees(scene.lines.angles), scene.lines.pitch
        group["angles"].attrs["units"], group["pixel_size"].attrs["units"] = "degree", "mm"
