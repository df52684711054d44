"""A checkpoint restores a fit bit for bit; an invalid one is reported with its error."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting import optimise as fit
from recon.splatting.checkpoint import arrays_of, state_from
from recon.splatting.problem import FitProblem
from recon.splatting.settings import DensityPolicy, FitSettings, growth
from recon.splatting.splat import project
from tests.messages import refused
from tests.recon.conftest import Make

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 7, endpoint=False), (14, 20))
GRID = Grid.matching(VIEWS)
SETTINGS = FitSettings(policy=DensityPolicy(start=0, stop=1, every=4, threshold=0.0, growth=2.0), tv_size=8)


def _problem(random_gaussians: Make) -> FitProblem:
    return fit.problem_of(Views(project(random_gaussians(30, 9.0), VIEWS).numpy(), VIEWS), GRID, 1.0, SETTINGS)


@pytest.mark.parametrize("at", [1, 5, 11])
def test_a_fit_taken_up_again_is_the_fit_that_was_not_left(random_gaussians: Make, at: int) -> None:
    problem, start = _problem(random_gaussians), random_gaussians(20, 9.0)
    whole, parts = (fit.init(start, 3, growth(SETTINGS)) for _ in range(2))
    for k in range(16):
        fit.step(whole, problem, SETTINGS, k / 16)
        fit.step(parts, problem, SETTINGS, k / 16)
        if k == at:
            file = io.BytesIO()  # through a file, as numbers and nothing else
            arrays: dict[str, Any] = {**arrays_of(parts)}
            np.savez(file, **arrays)
            file.seek(0)
            parts = state_from(dict(np.load(file, allow_pickle=False)))
    mine, others = arrays_of(whole), arrays_of(parts)
    assert mine.keys() == others.keys()
    for name, values in mine.items():
        np.testing.assert_array_equal(values, others[name], err_msg=name)
    assert whole.n > 20  # density control drew random numbers on the way


@pytest.mark.parametrize("kernel", Kernel)
def test_the_kernel_is_kept(random_gaussians: Make, kernel: Kernel) -> None:
    arrays = arrays_of(fit.init(random_gaussians(5, kernel=kernel), 0))
    assert fit.gaussians_of(state_from(arrays)).kernel is kernel


def test_what_is_no_checkpoint_is_refused(random_gaussians: Make) -> None:
    arrays = arrays_of(fit.init(random_gaussians(5), 0))
    with refused(ValueError):
        state_from({k: v for k, v in arrays.items() if k != "first.means"})
    with refused(ValueError):
        state_from({**arrays, "second.raw": arrays["second.raw"][:-1]})
    with refused(ValueError):
        state_from({**arrays, "kernel_exponent": np.ones(2)})
    with refused(ValueError):
        state_from({**arrays, "kernel_exponent": np.array(7.0)})
    with refused(ValueError):
        state_from({**arrays, "parameters.raw": np.full(5, np.nan, np.float32)})
    other = fit.init(random_gaussians(5), np.random.Generator(np.random.MT19937(0)))
    with refused(ValueError):
        arrays_of(other)
