"""A flat sample: removing rings leaves no mirror image of it on the other side of the axis."""

from __future__ import annotations

import numpy as np
import pytest

import recon
from recon.base.geometry import Geometry
from recon.features.rings import REMOVERS
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Box

COLS, MU, AWAY = 128, 0.02, 26.0


@pytest.mark.parametrize(("axis", "turn", "views"), [(63.5, np.pi, 120), (14.0, 2 * np.pi, 240)])
@pytest.mark.parametrize("name", ["auto", *REMOVERS])
def test_a_slab_has_no_ghost_beyond_the_axis(name: str, axis: float, turn: float, views: int) -> None:
    """The views that see the slab edge-on have a bright column of it, which a filter of columns takes for a stripe."""
    angles = np.linspace(0, turn, views, endpoint=False) + 0.003
    slab, detector = (
        Phantom.of((Box((48.0, 3.0, 8.0), MU, centre=(AWAY, 0.0, 0.0)),)),
        Detector((1, COLS), 1.0, axis, 0.0),
    )
    rng = np.random.default_rng(1)
    gains = rng.normal(0, 0.004, COLS)
    gains[[40, 70, 90]] += 0.03
    lines = np.stack([slab.line_integrals(angle, detector) for angle in angles])
    clean = (-np.log(rng.poisson(4e4 * np.exp(-lines)) / 4e4)).astype(np.float32)
    geometry = Geometry.parallel(angles, (1, COLS), axis_col=axis)
    before = recon.reconstruct(clean, geometry, "fbp").volume.data[0]
    y, x = np.indices(before.shape) - (np.array(before.shape)[:, None, None] - 1) / 2
    mirrored, there = ((np.abs(y) < 2) & (np.abs(x - side) < 20) for side in (-AWAY, AWAY))
    assert before[there].mean() > 0.4 * MU
    for ringed in (clean, clean + gains.astype(np.float32)):
        kept = recon.remove_rings(ringed, angles, name, axis).data  # type: ignore[arg-type]
        ghost = recon.reconstruct(kept, geometry, "fbp").volume.data[0] - before
        assert abs(ghost[mirrored].mean()) < 0.005 * MU
