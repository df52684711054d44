"""A test fit: it ends early if voxel methods lead, and never uses held-out projections."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.auto import Auto
from recon.base.geometry import Geometry
from recon.base.method import ReconProblem, Reconstruction, RunControl
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting.r2 import R2
from recon.voxels.direct import Fbp
from recon.voxels.methods import FistaTv, PnpDct
from recon.voxels.projector import Projector

F32 = NDArray[np.float32]
VIEWS = Geometry.parallel(np.linspace(0, math.pi, 30, endpoint=False), (8, 40))
GRID = Grid.matching(VIEWS)


@dataclass(frozen=True, eq=False)
class Poor(R2):
    """A fit a hundred times as dense, which no sweeps mend."""

    views: list[int] = field(default_factory=list)

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        self.views.append(problem.geometry.n_views)
        fitted = replace(R2(), steps=5, gaussians=50, finish=0).run(problem, control)
        fitted.volume.data[...] *= 100
        return fitted


@pytest.fixture
def problem(rng: np.random.Generator) -> ReconProblem:
    """A box, sharp to the voxel: what Gaussians do badly."""
    z, y, x = np.meshgrid(*GRID.coordinates(), indexing="ij")
    box = (0.3 * ((abs(x + 4) < 5) & (abs(y) < 8) & (abs(z) < 3))).astype(np.float32)
    data = Projector(VIEWS, GRID).forward(box) + rng.normal(0, 0.02, (30, 8, 40)).astype(np.float32)
    return ReconProblem(Views(data, VIEWS), GRID)


def test_a_fit_that_voxels_lead_ends_after_a_quarter_of_its_steps(problem: ReconProblem) -> None:
    poor = Poor()
    choice = Auto((Fbp(), FistaTv(), PnpDct(), poor)).choose(problem, RunControl())
    assert choice.chosen in (1, 2) and choice.prior is not None and choice.prior.weight > 0
    assert poor.views == [26]  # views held out are not fitted
    assert "r2 stopped after 25% of its steps" in choice.reason and "a full test takes about" in choice.reason
    poor.views.clear()
    choice = Auto((FistaTv(), poor), least_gain=0.0).choose(problem, RunControl())
    assert choice.chosen == 0 and poor.views == [26, 26] and "stopped" not in choice.reason


def test_few_views_and_a_stop_choose_nothing(problem: ReconProblem) -> None:
    few = replace(problem, views=problem.views.select(np.arange(12)))
    none = Auto().choose(few, RunControl())
    assert none.chosen is None and none.prior is None and "12 projections are too few" in none.reason
    looks = iter([False] * 30)
    stopped = Auto().choose(problem, RunControl(lambda: next(looks, True)))
    assert stopped.chosen is None and stopped.reason == "stopped before the choice"


def test_a_fit_with_a_finish_of_its_own_is_run_as_it_is(problem: ReconProblem) -> None:
    poor = Poor(finish=5)
    choice = Auto((FistaTv(), poor)).choose(problem, RunControl())
    assert choice.chosen == 0 and poor.views == [26] and "stopped" not in choice.reason
