"""MethodConformance: tests that every reconstruction method must pass, as a pytest class to derive from.

class TestMine(MethodConformance):
    @pytest.fixture
    def method(self) -> Mine:
        return Mine(iterations=3)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.method import (
    Method,
    ReconProblem,
    Reconstruction,
    RunControl,
)
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.voxels.projector import Projector

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (6, 24), pixel_pitch=0.5)
GRID = Grid.matching(VIEWS)
BOX = slice(1, 5), slice(8, 15), slice(6, 13)  # voxels with material


def problem() -> ReconProblem:
    """A small box of 0.2 /mm away from the axis."""
    truth = np.zeros(GRID.shape, np.float32)
    truth[BOX] = 0.2
    return ReconProblem(Views(Projector(VIEWS, GRID).plain.forward(truth), VIEWS), GRID, seed=3)


_WHOLE: dict[str, Reconstruction] = {}


def whole(method: Method) -> Reconstruction:
    """The reconstruction of the problem, computed once for all tests that compare with it; tests must not change it."""
    if repr(method) not in _WHOLE:
        result = _WHOLE[repr(method)] = method.run(problem(), RunControl())
        result.volume.data.flags.writeable = False
    return _WHOLE[repr(method)]


class MethodConformance:
    """Tests of `recon.base.method.Method`. A subclass defines the fixture `method`, with settings that take seconds."""

    @pytest.fixture
    def method(self) -> Method:
        pytest.fail(
            "Define the fixture `method` in your subclass: it must return the method to test, with settings with "
            "which a run takes only seconds."
        )

    def test_it_is_an_immutable_value_that_says_who_it_is(self, method: Method) -> None:
        assert is_dataclass(method) and method.__dataclass_params__.frozen
        assert method.name and method.label and isinstance(method, Method)
        type(method)()  # every setting has a default

    def test_its_volume_is_on_the_grid_and_has_the_matter_where_it_is(self, method: Method) -> None:
        result = whole(method)
        data = result.volume.data
        assert result.volume.grid == GRID and data.shape == GRID.shape and data.dtype == np.float32
        assert np.isfinite(data).all()
        outside = np.ones(GRID.shape, bool)
        outside[BOX] = False
        assert data[BOX].mean() > 4 * abs(float(data[outside].mean()))

    def test_it_leaves_what_it_is_given_alone_and_the_same_seed_gives_the_same_volume(self, method: Method) -> None:
        given = problem()
        again, before = method.run(given, RunControl()), problem().projections
        np.testing.assert_array_equal(given.projections, before)
        np.testing.assert_array_equal(again.volume.data, whole(method).volume.data)

    def test_values_that_are_not_finite_do_no_harm(self, method: Method) -> None:
        given = problem()
        spoiled = given.projections.copy()
        spoiled[::5, 3, 4] = np.nan
        found = method.run(replace(given, views=Views(spoiled, VIEWS)), RunControl()).volume.data
        assert np.isfinite(found).all()
        expected = whole(method).volume.data
        assert np.abs(found - expected).mean() < 0.2 * np.abs(expected).mean()

    def test_it_tells_how_far_it_is_and_stops_when_it_is_asked_to(self, method: Method) -> None:
        steps: list[int] = []
        control = RunControl(should_stop=lambda: True, on_progress=lambda progress: steps.append(progress.step))
        result = method.run(problem(), control)
        assert result.volume.data.shape == GRID.shape
        if not method.fitted:
            assert result.history == ()
        else:
            assert steps and result.history
            assert result.history[-1].step <= 2  # the method stopped before the third step

    def test_its_toy_runs_and_its_memory_grows_with_the_volume(self, method: Method) -> None:
        assert type(method.toy()) is type(method)
        assert np.isfinite(method.toy().run(problem(), RunControl()).volume.data).all()
        tall = Grid((60, *GRID.shape[1:]), GRID.voxel_size)
        assert 4 * GRID.shape[0] * GRID.shape[1] * GRID.shape[2] <= method.memory(VIEWS, GRID, False)
        assert method.memory(VIEWS, GRID, False) <= method.memory(VIEWS, GRID, True)
        assert method.memory(VIEWS, GRID, False) < method.memory(VIEWS, tall, False)

    def test_it_takes_what_it_says(self, method: Method) -> None:
        assert method.takes <= {"device", "held_out", "times", "checkpoints", "quality", "budget", "reference"}
        assert method.halo >= 0 and method.volumes >= 1
        if "held_out" in method.takes:
            given = problem()
            views = replace(given.views, used=~np.isin(np.arange(VIEWS.n_views), [5, 17]))
            result = method.run(replace(given, views=views), RunControl())
            assert np.isfinite([progress.held_out for progress in result.history]).any()
        if "checkpoints" in method.takes:
            resumed = self._resumed(method, whole(method).checkpoint)
            np.testing.assert_array_equal(resumed.volume.data, whole(method).volume.data)

    def _resumed(self, method: Method, checkpoint: Mapping[str, NDArray[Any]] | None) -> Reconstruction:
        assert checkpoint is not None
        return method.run(problem(), RunControl(resume=checkpoint))
