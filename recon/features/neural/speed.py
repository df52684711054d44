"""How fast this machine fits a neural field: samples, and voxels of its volume."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

from recon.machine_speed import SizedRun, views_of_disc
from recon.methods import by_name, with_settings
from recon.reconstruction import reconstruct


def timed(which: str) -> tuple[SizedRun, ...]:
    """Steps of the method of this name."""
    geometry, grid, data = views_of_disc("parallel", 8, 64, 24)
    method: Any = by_name(which)()
    samples, voxels = method.rays * method.samples_of(64), math.prod(grid.shape)

    def run(steps: int) -> object:
        return reconstruct(data, geometry, with_settings(method, {"steps": steps}))

    return tuple(SizedRun(steps * samples, voxels, partial(run, steps)) for steps in (1, 4))
