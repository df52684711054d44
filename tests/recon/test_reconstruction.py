"""The public call: both methods, better than the baseline, honest about bad input."""

from __future__ import annotations

import numpy as np
import pytest

import recon
from recon.metrics import psnr
from simulators.phantom import Detector, Phantom
from simulators.solids import Cylinder, Ellipsoid

SHAPE, PITCH = (20, 40), 0.1
ANGLES = np.linspace(0, np.pi, 24, endpoint=False)
VIEWS = recon.Geometry.parallel(ANGLES, SHAPE, PITCH, axis_col=18.3)
GRID = recon.Grid.matching(VIEWS)


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    return Phantom.of((Cylinder(1.3, 1.6, 0.4), Ellipsoid((0.4, 0.3, 0.4), 1.0, centre=(0.5, 0.3, 0.1))))


@pytest.fixture(scope="module")
def noisy(phantom: Phantom) -> np.ndarray:
    rng = np.random.default_rng(5)
    detector = Detector(SHAPE, PITCH, VIEWS.axis_col, (SHAPE[0] - 1) / 2)
    clean = np.stack([phantom.line_integrals(a, detector) for a in ANGLES])
    counts = rng.poisson(2e4 * np.exp(-clean))
    return -np.log(np.maximum(counts, 1) / 2e4).astype(np.float32)


def test_few_noisy_views_beat_fbp(phantom: Phantom, noisy: np.ndarray) -> None:
    truth = phantom.attenuation(GRID)
    best = max(
        psnr(truth, recon.reconstruct(noisy, VIEWS, method="fbp", filter=name).volume.data)
        for name in ("ram-lak", "shepp-logan", "hann")
    )
    result = recon.reconstruct(noisy, VIEWS, steps=500, gaussians=2500)
    assert psnr(truth, result.volume.data) > best + 1
    assert result.volume.data.shape == GRID.shape and result.volume.data.dtype == np.float32
    assert result.history[-1].step == 500 and result.gaussians is not None
    assert result.settings["seed"] == 0


def test_the_same_seed_gives_the_same_volume(noisy: np.ndarray) -> None:
    first, second = (recon.reconstruct(noisy, VIEWS, steps=30, seed=4).volume.data for _ in range(2))
    np.testing.assert_array_equal(first, second)
    other = recon.reconstruct(noisy, VIEWS, steps=30, seed=5).volume.data
    assert not np.array_equal(first, other)


def test_a_model_can_be_continued(noisy: np.ndarray) -> None:
    first = recon.reconstruct(noisy, VIEWS, steps=60, gaussians=1500)
    second = recon.reconstruct(noisy, VIEWS, steps=60, gaussians=first.gaussians, densify=False)
    assert second.history[-1].residual < first.history[-1].residual
    assert second.history[-1].n_gaussians == first.history[-1].n_gaussians


def test_it_can_be_stopped_and_watched(noisy: np.ndarray) -> None:
    seen: list[int] = []
    result = recon.reconstruct(
        noisy, VIEWS, steps=10_000, gaussians=500,
        on_progress=lambda p: seen.append(p.step), should_stop=lambda: len(seen) >= 3,
    )  # fmt: skip
    assert result.history[-1].step < 10_000 and len(seen) >= 3
    assert np.isfinite(result.volume.data).all() and result.volume.data.max() > 0


def test_a_time_budget_is_kept(noisy: np.ndarray) -> None:
    ticks = iter(np.arange(0, 1e6, 0.05))
    result = recon.reconstruct(noisy, VIEWS, seconds=2.0, gaussians=500, now=lambda: float(next(ticks)))
    assert 5 <= result.history[-1].step <= 40


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "magic"}, "method must be one of"),
        ({"projections": np.zeros((3, 20, 40))}, "geometry says"),
        ({"projections": np.full((24, 20, 40), np.nan)}, "not finite"),
        ({"projections": np.zeros((24, 20, 40))}, "no matter"),
    ],
)
def test_bad_input_is_refused(noisy: np.ndarray, change: dict[str, object], message: str) -> None:
    arguments = {"projections": noisy, "geometry": VIEWS} | change
    with pytest.raises(ValueError, match=message):
        recon.reconstruct(**arguments)  # type: ignore[arg-type]


def test_one_view_is_refused(noisy: np.ndarray) -> None:
    with pytest.raises(ValueError, match="one view"):
        recon.reconstruct(noisy[:1], VIEWS.select([0]))
