"""Neural fields as methods: what a fit finds, what ends it, and its errors."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import recon
from recon.base.geometry import Geometry
from recon.base.method import RunControl
from recon.base.ray_width import RayWidth
from recon.base.volume import Grid
from recon.testing import MethodConformance
from recon.voxels.projector import Projector
from splatline_neural import NAF, IntraTomo, SaxNerf
from splatline_neural.methods import FieldMethod
from splatline_neural.networks import LineAttention
from tests.recon.helpers import data_residual
from tests.recon.saved import comes_back

ANGLES = np.linspace(0, 2 * np.pi, 12, endpoint=False)
VIEWS = {
    "parallel": Geometry.parallel(ANGLES, (8, 24), pixel_pitch=0.5),
    "cone": Geometry.cone(ANGLES, (8, 24), 0.75, 40.0, 60.0),
}
SMALL = {
    "naf": NAF(steps=120, rays=128, samples=16, rate=1e-2, levels=1),
    "intratomo": IntraTomo(steps=120, rays=128, samples=16, rate=1e-2, width=32, bands=3),
    "sax-nerf": SaxNerf(steps=150, rays=32, samples=12, rate=1e-2, levels=1, width=16, window_count=1, window_side=6),
}


pytestmark = pytest.mark.usefixtures("one_thread")


def box(geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """A box of 0.2 /mm off the axis, and its line integrals."""
    grid = Grid.matching(geometry)
    truth = np.zeros(grid.shape, np.float32)
    truth[1:6, 8:15, 6:13] = 0.2
    return truth, Projector(geometry, grid).forward(truth)


@pytest.mark.parametrize("beam", VIEWS)
@pytest.mark.parametrize("name", SMALL)
def test_a_field_finds_a_box(name: str, beam: str) -> None:
    truth, data = box(VIEWS[beam])
    found = recon.reconstruct(data, VIEWS[beam], SMALL[name])
    error = np.linalg.norm(found.volume.data - truth) / np.linalg.norm(truth)
    assert error < 0.5 and found.volume.data.min() >= 0
    assert data_residual(found.volume, data, VIEWS[beam]) < 0.25
    assert [progress.step for progress in found.history][-1] == SMALL[name].steps == found.settings["steps"]


@pytest.mark.parametrize("name", SMALL)
def test_densities_below_zero_are_found_where_they_are_allowed(name: str) -> None:
    """Air below zero: 0.02 on rays of 12 mm."""
    _, data = box(VIEWS["parallel"])
    method = replace(SMALL[name], allow_negative=True)
    assert recon.reconstruct(data - np.float32(0.02), VIEWS["parallel"], method).volume.data.min() < -5e-4


def test_attention_of_equal_scores_is_the_mean_of_a_segment_and_knows_no_other() -> None:
    attention = LineAttention(32)
    rng = torch.Generator().manual_seed(0)
    for values in attention.parameters():
        torch.nn.init.normal_(values, std=0.2, generator=rng)
    x = torch.randn(2, 6, 32, generator=rng)
    y = attention(x)
    moved = x.clone()
    moved[:, 2, ::2] += 1  # of the second segment
    changed = (attention(moved) - y).abs().amax((0, 2)) > 1e-6
    assert changed.tolist() == [False, False, True, True, False, False]
    same = x.reshape(2, 3, 2, 32)[:, :, :1].expand(2, 3, 2, 32).reshape(2, 6, 32)
    torch.testing.assert_close(attention(same)[:, ::2], attention(same)[:, 1::2])


def test_a_time_ends_a_fit() -> None:
    """By a clock that counts how often it is asked."""
    _, data = box(VIEWS["parallel"])
    clock = itertools.count()
    method = replace(SMALL["naf"], steps=10_000, seconds=60.0)
    found = recon.reconstruct(data, VIEWS["parallel"], method, control=RunControl(now=lambda: float(next(clock))))
    assert 5 < found.settings["steps"] < 60


def test_what_a_field_cannot_do_is_refused() -> None:
    _, data = box(VIEWS["parallel"])
    with pytest.raises(ValueError, match="no absorbing sample"):
        recon.reconstruct(np.zeros_like(data), VIEWS["parallel"], NAF())
    with pytest.raises(ValueError, match=r"'naf' has no option resume"):
        recon.reconstruct(data, VIEWS["parallel"], NAF(), control=RunControl(resume={}))
    with pytest.raises(ValueError, match="steps must be a whole number >= 1"):
        IntraTomo(steps=0)


def test_a_width_of_rays_and_a_density_beyond_the_highest_are_told() -> None:
    _, data = box(VIEWS["parallel"])
    with pytest.warns(UserWarning, match="supports only thin rays"):
        recon.reconstruct(data, VIEWS["parallel"].seen_with(RayWidth(1.0)), replace(SMALL["naf"], steps=1))
    with pytest.warns(UserWarning, match=r"give a larger `highest` than 0\.3"):
        recon.reconstruct(data, VIEWS["parallel"], replace(SMALL["naf"], highest=0.3))


def test_the_published_grid_has_sixteen_levels_and_ours_ends_at_a_voxel() -> None:
    with torch.device("meta"):
        published = NAF(levels=16).network(256).encoding
        ours = NAF().network(256).encoding
    assert published.width == 32 and published.table.numel() == 2 * (17**3 + 33**3 + 65**3 + 13 * 2**19)
    assert ours.sides.tolist() == [17, 33, 65, 129, 257]


@pytest.mark.parametrize("method", [NAF(), SaxNerf(), IntraTomo()])
def test_samples_follow_the_voxels(method: FieldMethod) -> None:
    assert method.samples_of(256) == 320 and method.samples_of(9) == 12


@pytest.mark.parametrize("name", SMALL)
def test_a_result_is_saved_and_comes_back(name: str, tmp_path: Path) -> None:
    comes_back(recon.reconstruct(box(VIEWS["parallel"])[1], VIEWS["parallel"], SMALL[name].toy()), tmp_path / "v.npz")


@pytest.mark.parametrize("name", SMALL)
class TestConformance(MethodConformance):
    @pytest.fixture
    def method(self, name: str) -> FieldMethod:
        if name == "sax-nerf":  # without windows, whose rays a pixel without a value changes
            return SaxNerf(steps=120, rays=64, samples=12, levels=1, width=16, window_count=0)
        return SMALL[name]
