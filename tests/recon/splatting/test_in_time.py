"""In time: the seconds of a fit are those of the whole run."""

from __future__ import annotations

import time

import numpy as np
import pytest

import recon
from recon import R2, Geometry, Grid, RunControl
from recon.splatting.in_time import finish_within
from recon.voxels.projector import Projector

VIEWS = Geometry.cone(np.deg2rad(np.arange(61) * 360 / 61), (24, 40), 0.2, 100.0, 150.0)


class Ticking:
    """A clock that a look at it moves on by a tick."""

    def __init__(self, tick: float) -> None:
        self._tick, self._now = tick, 0.0

    def __call__(self) -> float:
        self._now += self._tick
        return self._now


@pytest.fixture(scope="module")
def data() -> np.ndarray:
    grid = Grid.matching(VIEWS)
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    radius = grid.shape[2] * grid.voxel_size / 2
    disc = (np.hypot(x, y) < 0.6 * radius) & ~(np.hypot(x - 0.2 * radius, y) < 0.2 * radius)
    views = Projector(VIEWS, grid).forward((0.05 * disc).astype(np.float32))
    return views + np.random.default_rng(0).normal(0, 0.01, views.shape).astype(np.float32)


def test_a_finish_gets_as_many_sweeps_as_its_time_suffices_for() -> None:
    views = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (6, 40))
    grid = Grid.matching(views)
    # 24 views in two subsets, a look a tick: 3 ticks of views, 2 steps of total variation; before the first sweep 6
    # and four trials of 16 over seven of eight views.
    found = [finish_within(s, 0.0, views, grid, Ticking(1.0)) for s in (0.0, 316.0, 321.0, 340.0, 1e3)]
    assert found == [(0, 0.0), (0, 0.0), (2, 320.0), (6, 340.0), (8, 350.0)]
    # As many as views held out prefer, where time is left for 24, for as many of a trial and for three trials of 16.
    found = [finish_within(1e3, spare, views, grid, Ticking(1.0)) for spare in (744.0, 745.0)]
    assert found == [(8, 350.0), (None, 745.0)]


@pytest.mark.usefixtures("one_thread")
def test_the_seconds_bound_start_steps_finish_and_volume(data: np.ndarray) -> None:
    """In processor seconds: the time beyond them is at most that of a sweep, or of what measures it."""
    recon.reconstruct(data, VIEWS, R2(steps=4, gaussians=300), control=RunControl(should_stop=lambda: True))
    begin = time.process_time()
    found = recon.reconstruct(data, VIEWS, R2(seconds=2.0), control=RunControl(now=time.process_time))
    assert 0.5 < time.process_time() - begin < 2.4
    assert found.settings["steps"] > 3


@pytest.mark.usefixtures("one_thread")
def test_too_few_seconds_are_said_before_the_start_and_still_give_a_volume(data: np.ndarray) -> None:
    said: list[int] = []
    with pytest.warns(UserWarning, match=r"0.001 s do not suffice for the start .* binned 4 x 4"):
        found = recon.reconstruct(
            data, VIEWS, R2(seconds=0.001, gaussians=300), control=RunControl(on_progress=lambda p: said.append(p.step))
        )
    assert found.settings["steps"] == 1 and found.settings["finish"] == 0
    assert np.isfinite(found.volume.data).all() and found.volume.data.max() > 0
