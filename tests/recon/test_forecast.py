"""Forecast of run times from iterations on a part, with a controlled clock, for methods of every kind."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

import recon
from recon.base.geometry import Geometry
from recon.base.method import Method, Progress, ReconProblem, Reconstruction, RunControl
from recon.base.volume import Grid, Volume
from recon.features.iterative.methods import Sirt
from recon.forecast import forecast, part_of
from recon.methods import by_name, names_compared
from tests.clock import SteppedClock

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 200, endpoint=False), (100, 300))
GRID = Grid.matching(VIEWS)


@dataclass(frozen=True)
class Ticking(Sirt):
    """Takes so many seconds for a voxel in a view, and for each iteration."""

    clock: SteppedClock = field(default_factory=lambda: SteppedClock(0.0))
    made: list[int] = field(default_factory=list)

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        work = 1e-9 * problem.geometry.n_views * math.prod(problem.grid.shape)
        self.clock.time += 5 * work
        for n in range(1, self.iterations + 1):
            self.clock.time += 2 * work
            self.made.append(n)
            control.tell(Progress(n, self.iterations, 0.0, 1.0, 1.0, 0, problem.geometry.n_views))
            if control.stop():
                break
        return Reconstruction(Volume(np.zeros(problem.grid.shape, np.float32), problem.grid), {})


@pytest.mark.parametrize("iterations", [1, 3, 50])
def test_few_iterations_on_a_part_foretell_all(iterations: int) -> None:
    method = Ticking(iterations=iterations)
    found = forecast(method, VIEWS, GRID, method.clock)
    assert found is not None and found.least == found.most
    assert found.most == pytest.approx(1e-9 * 200 * math.prod(GRID.shape) * (5 + 2 * iterations))
    assert len(method.made) <= 4


@pytest.mark.parametrize("shape", [(100, 300), (2, 600), (1, 40)])
@pytest.mark.parametrize("cone", [False, True])
def test_a_part_is_small_and_looks_like_the_views(shape: tuple[int, int], cone: bool) -> None:
    angles = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    views = Geometry.cone(angles, shape, 1.0, 2000.0, 4000.0) if cone else Geometry.parallel(angles, shape)
    part = part_of(views, Grid.matching(views), 2**16)
    assert part.projections.shape == (part.geometry.n_views, *part.geometry.detector_shape)
    assert math.prod(part.grid.shape) <= 2**17 and part.geometry.is_cone == cone
    assert Grid.matching(part.geometry) == part.grid and part.projections.max() > 0.3


@pytest.mark.parametrize("name", [*names_compared(), "auto"])
def test_each_method_that_is_compared_can_be_foretold(name: str) -> None:
    """Less for a sixteenth of the voxels."""
    views = Geometry.parallel(np.linspace(0, np.pi, 20, endpoint=False), (8, 32))
    now = SteppedClock(0.0, 0.01)
    method = by_name(name)() if name != "auto" else recon.Auto()
    found = forecast(method, views, Grid.matching(views), now)
    assert found is not None and 0 < found.least <= found.most < math.inf


def test_the_finish_of_a_fit_tries_few_materials_before_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    views = Geometry.parallel(np.linspace(0, np.pi, 20, endpoint=False), (8, 32))

    def choice_seconds(method: Method) -> float:
        found = forecast(method, views, Grid.matching(views), SteppedClock(0.0, 0.01))
        assert found is not None
        return found.choice_seconds

    smooth, with_materials = choice_seconds(recon.FistaTv()), choice_seconds(recon.R2())
    monkeypatch.setattr("recon.forecast.pull_methods", list)
    added = recon.Discrete().refused_sweeps / recon.FistaTv().trial_sweeps
    assert with_materials - choice_seconds(recon.R2()) == pytest.approx(added * smooth)


def test_what_a_time_ends_takes_it_and_several_volumes_have_to_be_tried() -> None:
    ended: Method = recon.R2(seconds=30.0)
    found = forecast(ended, VIEWS, GRID, SteppedClock(0.0))
    assert found is not None and found.most == 30
    assert forecast(by_name("series")(), VIEWS, GRID, SteppedClock(0.0)) is None
