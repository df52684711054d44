"""The seconds that `recon --dry-run` expects beside those that a run takes, by beam and method, in CPU seconds.

Of a fit it expects two figures; the one that counts is that of the steps which it took.

Run with  pytest -m bench -s tests/bench/test_dry_run.py  (two minutes).
"""

from __future__ import annotations

import time

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon.base.choices import DEFAULT_STEPS
from recon.base.geometry import Geometry
from recon.base.method import Method
from recon.base.ray_width import RayWidth
from recon.base.volume import Grid
from recon.run_time import Extent, run_seconds
from recon.voxels.projector import Projector

_WITHIN, _PHOTONS = 0.3, 1e4
_COLS, _ROWS, _VIEWS = 160, 40, 90
_FAN, _FAN_VIEWS = 512, 180
_TURN = np.linspace(0, 2 * np.pi, _VIEWS, endpoint=False)

BEAMS = {
    "parallel": Geometry.parallel(_TURN / 2, (_ROWS, _COLS)),
    "cone": Geometry.cone(_TURN, (_ROWS, _COLS), 1.0, 4 * _COLS, 8 * _COLS),
    "fan": Geometry.fan(np.linspace(0, 2 * np.pi, _FAN_VIEWS, endpoint=False), _FAN, 1.0, 4 * _FAN, 8 * _FAN),
    "parallel, 4 px of motion": Geometry.parallel(_TURN / 2, (_ROWS, _COLS)).seen_with(RayWidth(arc=0.05)),
}
METHODS = (recon.Fbp(), recon.Sirt(iterations=30), recon.FistaTv(), recon.R2())


def _views(geometry: Geometry) -> NDArray[np.float32]:
    """Line integrals of balls in a cylinder, with the noise of 10 000 photons."""
    rng, grid = np.random.default_rng(1), Grid.matching(geometry)
    z, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    width, height = grid.voxel_size * grid.shape[2], grid.voxel_size * grid.shape[0]
    volume = np.where(np.hypot(x, y) < 0.42 * width, 1.5 / width, 0).astype(np.float32)
    for _ in range(60):
        radius, angle = 0.4 * width * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
        at = radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-height / 2, height / 2)
        ball = (x - at[0]) ** 2 + (y - at[1]) ** 2 + (z - at[2]) ** 2 < rng.uniform(0.01, 0.06) ** 2 * width**2
        volume[ball] = rng.choice([0, 0.75, 2.25]) / width
    photons = rng.poisson(_PHOTONS * np.exp(-Projector(geometry, grid).forward(volume)))
    return (-np.log(np.maximum(photons, 1) / _PHOTONS)).astype(np.float32)


@pytest.mark.bench
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
@pytest.mark.parametrize("beam", BEAMS)
def test_a_run_takes_the_seconds_that_were_expected(beam: str, method: Method) -> None:
    geometry, now = BEAMS[beam], time.process_time
    data = _views(geometry)
    few = slice(None, None, geometry.n_views // 24)
    recon.reconstruct(data[few], geometry.select(few), method.toy())  # compiles
    expected = run_seconds(method, Extent(geometry, [Grid.matching(geometry).shape[0]]), now)
    begin, repeats = now(), 3 if method.traits.direct else 1
    for _ in range(repeats):
        found = recon.reconstruct(data, geometry, method)
    taken = (now() - begin) / repeats
    ended = isinstance(method, recon.R2) and found.settings["steps"] < DEFAULT_STEPS
    which = expected.least if ended else expected.most
    print(
        f"\n{beam}, {method.name}: {which:.2f} CPU s expected, {taken:.2f} taken, ratio {which / taken:.2f}, {expected}"
    )
    assert which == pytest.approx(taken, rel=_WITHIN)
