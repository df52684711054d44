"""After warm_up no kernel of a fit is compiled any more."""

from __future__ import annotations

import numpy as np

import recon
from recon.kernels import activation, adam_cpu, footprints_cpu, losses_cpu, project_cpu, voxelize_cpu
from recon.warm_up import warm_up


def _compiled() -> dict[str, int]:
    """Specialisations of each jitted function of the kernels."""
    found = {}
    for module in (activation, adam_cpu, footprints_cpu, losses_cpu, project_cpu, voxelize_cpu):
        for name, value in vars(module).items():
            if type(value).__name__ == "CPUDispatcher":
                found[f"{module.__name__}.{name}"] = len(value.signatures)
    return found


def test_a_fit_after_warm_up_compiles_nothing() -> None:
    warm_up()
    before = _compiled()
    assert len(before) > 10
    views = recon.Geometry.parallel(np.linspace(0, 3, 6), (10, 20), pixel_pitch=0.5)
    data = np.exp(-(((np.arange(20) - 9) / 4.0) ** 2))[None, None] * np.ones((6, 10, 1))
    recon.reconstruct(data, views, steps=150, gaussians=60)
    assert _compiled() == before
