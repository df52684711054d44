"""Emission: writes the counts of a scene that emits into a file that `beamline recon` reads."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from beamline.core.errors import ConfigError
from beamline.core.files import whole_file
from beamline.core.machine import free_memory
from beamline.core.text import size
from beamline.storage import hdf5
from simulators.scenes.emission import EmissionScene as EmissionScene
from simulators.scenes.emission import Events, events

_BYTES_A_LINE = 120  # as measured


def emit(scene: EmissionScene, seed: int, progress: Callable[[int, int], object]) -> Events:
    """The counts of a scene. Raises ConfigError where the memory does not hold them."""
    needed, free = _BYTES_A_LINE * scene.lines.views * math.prod(scene.lines.shape), free_memory()
    if needed > free:
        raise ConfigError(
            f"The lines take {size(needed)} of memory, {size(free)} are free. Give fewer lines, or --frames. Nothing "
            "was simulated."
        )
    return events(scene.emission, scene.lines.detector, scene.lines.angles, scene.scanner, seed, progress)


def write_emission(path: Path, scene: EmissionScene, made: Events) -> None:
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
