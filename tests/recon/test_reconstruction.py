"""The public call: both methods, better than the baseline, honest about bad input."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

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


def test_a_small_box_holds_what_the_whole_volume_holds_there(noisy: np.ndarray) -> None:
    # The matter outside the box is in the views, so it must be in the model.
    z, y, x = GRID.coordinates()
    box = recon.Grid((6, 12, 10), PITCH, centre=(float(z[9:15].mean()), float(y[20:32].mean()), float(x[5:15].mean())))
    whole, part = (recon.reconstruct(noisy, VIEWS, grid, steps=60).volume.data for grid in (GRID, box))
    np.testing.assert_allclose(part, whole[9:15, 20:32, 5:15], atol=1e-3 * whole.max())


def test_matter_beyond_the_default_grid_is_explained() -> None:
    # A full turn with the axis near the edge: the detector sees a sample wider than itself.
    sample = Phantom.of((Cylinder(2.6, 1.6, 0.2), Ellipsoid((0.5, 0.4, 0.4), 0.6, centre=(-0.6, 0.4, 0.1))))
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    detector = Detector(SHAPE, PITCH, 32.0, (SHAPE[0] - 1) / 2)
    views = recon.Geometry.parallel(turn, SHAPE, PITCH, axis_col=32.0)
    data = np.stack([sample.line_integrals(a, detector) for a in turn])
    grid = recon.Grid.of_field(views, PITCH)
    result = recon.reconstruct(data, views, grid, steps=400, gaussians=2500)
    assert result.history[-1].residual < 0.06
    assert psnr(sample.attenuation(grid), result.volume.data) > 25


@pytest.mark.parametrize(
    "kind",
    [
        lambda a: torch.from_numpy(a.astype(np.float64)).requires_grad_(),
        lambda a: np.asfortranarray(a),
        lambda a: np.repeat(a, 2, axis=2)[:, :, ::2],
        lambda a: a.astype(np.float64).tolist(),
    ],
)
def test_any_kind_of_array_gives_the_same_volume(noisy: np.ndarray, kind: Callable[[np.ndarray], object]) -> None:
    expected = recon.reconstruct(noisy, VIEWS, steps=5, gaussians=300).volume.data
    found = recon.reconstruct(kind(noisy), VIEWS, steps=5, gaussians=300).volume.data  # type: ignore[arg-type]
    np.testing.assert_array_equal(found, expected)


def test_no_step_gives_the_starting_point(noisy: np.ndarray) -> None:
    result = recon.reconstruct(noisy, VIEWS, steps=0, gaussians=300)
    assert [p.step for p in result.history] == [0] and result.history[0].n_gaussians == 300
    assert result.gaussians is not None and result.volume.data.max() > 0
    # Scaled to the data: the sum of the volume is that of the line integrals.
    mass = float(result.volume.data.sum()) * PITCH
    assert mass == pytest.approx(float(noisy.sum(axis=(1, 2)).mean()), rel=0.1)


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
        ({"projections": np.full((24, 20, 40), 1e300)}, "not finite"),
        ({"projections": np.ones((24, 20, 40), complex)}, "real numbers"),
        ({"projections": np.zeros((24, 20, 40))}, "no matter"),
        ({"filter": "magic"}, "filter must be one of"),
        ({"steps": -1}, "steps must be"),
        ({"seconds": -1.0}, "seconds must be"),
        ({"seconds": float("nan")}, "seconds must be"),
        ({"gaussians": 0}, "at least one Gaussian"),
        ({"geometry": VIEWS.at(np.pi * np.arange(24) + 0.3)}, "24 views from one side"),
    ],
)
def test_bad_input_is_refused(noisy: np.ndarray, change: dict[str, object], message: str) -> None:
    arguments = {"projections": noisy, "geometry": VIEWS} | change
    with pytest.raises(ValueError, match=message):
        recon.reconstruct(**arguments)  # type: ignore[arg-type]


def test_one_view_is_refused(noisy: np.ndarray) -> None:
    with pytest.raises(ValueError, match="one view"):
        recon.reconstruct(noisy[:1], VIEWS.select([0]))
