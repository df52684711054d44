"""Settings of a fit: values out of range are errors; total variation follows the noise and the grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, Truncation
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting import optimise as fit
from recon.splatting.problem import join_pixels
from recon.splatting.settings import FitSettings, in_steps, tv_size, tv_weight


def test_settings_out_of_range_are_refused() -> None:
    for bad in (
        {"views_per_step": 0}, {"joined_pixels": 0}, {"joined_pixels": 2.5}, {"tv_size": 0}, {"tv_weight": -1.0},
        {"tv_weight": float("inf")}, {"ssim_weight": float("nan")}, {"pace": float("nan")}, {"pace": -1.0},
        {"decay": -1.0}, {"smallest": 0.0}, {"rates": (1e-3, 1e-3, 1e-3)},
        {"kernel": "box"},
    ):  # fmt: skip
        with pytest.raises(ValueError, match=next(iter(bad))):
            FitSettings(**bad)
    for wrong in ({"sigmas": -1.0}, {"sigmas": float("nan")}, {"faint": -1.0}, {"faint": float("inf")}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Truncation(**wrong)


def test_a_kernel_goes_by_its_name() -> None:
    for kernel in Kernel:
        assert FitSettings(kernel=kernel.value).kernel is kernel  # type: ignore[arg-type]


def test_a_longer_fit_is_slower_and_asks_less_of_its_prior() -> None:
    usual = FitSettings()
    assert in_steps(usual, 50) == in_steps(usual, 400) == usual
    longer = in_steps(usual, 1600)
    assert (longer.pace, longer.tv_least) == (13.0, 0.01)


_WITHOUT_LIMITS = {noise: 3e5 * noise**2 / 24 for noise in (1e-4, 2e-3, 4e-3, 0.1)}


@pytest.mark.parametrize(("noise", "weight"), [(1e-4, 0.02), (2e-3, 0.05), (4e-3, 0.2), (0.1, 0.25)])
def test_total_variation_weighs_by_the_noise_of_the_data(rng: np.random.Generator, noise: float, weight: float) -> None:
    """3e5 times its variance, over 24 pixels a Gaussian; and the same on pixels binned two by two."""
    views = Geometry.parallel(np.linspace(0, np.pi, 12, endpoint=False), (64, 64))
    grid = Grid.matching(views)
    flat = np.full((views.n_views, *views.detector_shape), 5.0)
    scale = 0.7 * max(grid.shape) * grid.voxel_size / 2
    data = flat + rng.normal(0, noise * scale, flat.shape)
    settings, count = FitSettings(), flat.size // 24
    problem = fit.problem_of(Views(data.astype(np.float32), views), grid, 0.7, settings)
    assert tv_weight(settings, problem, count) == pytest.approx(weight, rel=0.1)
    joined = join_pixels(Views(data.astype(np.float32), views), 2)
    binned, joined_views = joined.data, joined.geometry
    rough = fit.problem_of(Views(binned, joined_views), grid, 0.7, settings)
    assert tv_weight(settings, rough, count) == pytest.approx(weight, rel=0.1)
    assert tv_weight(FitSettings(tv_weight=0.0), problem, count) == 0
    sharp = replace(problem, change=0.32)  # noise counts by the change of matter: half of it, beyond 0.16
    assert tv_weight(settings, sharp, count) == pytest.approx(np.clip(_WITHOUT_LIMITS[noise] / 4, 0.02, 0.25), rel=0.1)
    assert tv_weight(settings, replace(problem, change=0.1), count) == tv_weight(settings, problem, count)


@pytest.mark.parametrize(
    ("shape", "size"),
    [((8, 8, 8), 32), ((128, 128, 128), 32), ((96, 256, 256), 48), ((256,) * 3, 64), ((900,) * 3, 96)],
)
def test_total_variation_looks_at_a_64th_of_the_grid(shape: tuple[int, int, int], size: int) -> None:
    assert tv_size(FitSettings(), Grid(shape)) == size
    assert tv_size(FitSettings(tv_size=20), Grid(shape)) == 20
