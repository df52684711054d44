"""Discrete tomography: its gain on grains of two materials, and samples for which discrete levels are rejected."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

import recon
from recon.base.decisions import Decisions
from recon.base.method import RunControl
from recon.features.discrete.methods import UNDECIDED
from recon.voxels.half_voxels import HALVES
from recon.voxels.methods import PnpDct
from recon.voxels.projector import Projector

F32 = NDArray[np.float32]
VIEWS, MORE_VIEWS = (recon.Geometry.parallel(np.arange(n) * np.pi / n, (6, 64)) for n in (20, 40))
GRID = recon.Grid.matching(VIEWS)


def grains() -> F32:
    """Balls of 0.05 in a can of 0.015, with partial voxels at their faces."""
    rng, (z, y, x) = np.random.default_rng(2), np.meshgrid(*GRID.coordinates(), indexing="ij")
    truth = 0.015 * np.clip(28.5 - np.hypot(x, y), 0, 1)
    for _ in range(300):
        (r, turn, height), away = rng.uniform((2, 0, -5), (3.5, 2 * np.pi, 5)), 24 * math.sqrt(rng.uniform())
        far = np.sqrt((x - away * np.cos(turn)) ** 2 + (y - away * np.sin(turn)) ** 2 + (z - height) ** 2)
        truth = np.maximum(truth, 0.015 + 0.035 * np.clip(r + 0.5 - far, 0, 1))
    return truth.astype(np.float32)


def smooth() -> F32:
    away = np.hypot(*np.meshgrid(GRID.coordinates()[1], GRID.coordinates()[2], indexing="ij"))
    noise = gaussian_filter(np.random.default_rng(0).normal(0, 1, GRID.shape), (2, 5, 5))
    return ((0.03 + 0.01 * noise / noise.std()).clip(0) * (away < 28)).astype(np.float32)


def measured(truth: F32, geometry: recon.Geometry = VIEWS) -> F32:
    clean = Projector(geometry, GRID).forward(truth)
    counts = np.random.default_rng(0).poisson(3e4 * np.exp(-clean.astype(float)))
    return -np.log(counts / 3e4).astype(np.float32)


@pytest.fixture(scope="module")
def of_grains() -> recon.Reconstruction:
    return recon.reconstruct(measured(grains()), VIEWS, recon.Discrete())


def error(volume: F32, truth: F32) -> float:
    return float(np.sqrt(np.mean((volume - truth) ** 2)))


@pytest.mark.slow
def test_grains_of_two_materials_are_nearer_to_the_truth(of_grains: recon.Reconstruction) -> None:
    tv = recon.reconstruct(measured(grains()), VIEWS, recon.FistaTv()).volume.data
    assert error(of_grains.volume.data, grains()) < 0.9 * error(tv, grains())
    levels = of_grains.settings["levels_of_materials"]
    assert len(levels) == 2
    np.testing.assert_allclose(levels, (0.015, 0.05), atol=0.002)
    assert 0 < of_grains.settings[UNDECIDED] < 1


@pytest.mark.slow
def test_the_record_counts_all_iterations(of_grains: recon.Reconstruction) -> None:
    assert not of_grains.chosen and of_grains.settings["ended_after"] == len(of_grains.history)


@pytest.mark.slow
def test_the_probability_of_each_material_is_there_on_demand(of_grains: recon.Reconstruction) -> None:
    p, truth = recon.Discrete.probabilities(of_grains.volume, of_grains.settings), grains()
    assert p is not None and p.shape == (2, *GRID.shape)
    assert p[1][truth == 0.05].mean() > 3 * p[1][truth == 0.015].mean()


@pytest.mark.slow
def test_with_levels_half_voxels_are_tested_for_more_than_a_third_as_many_projections_as_columns() -> None:
    """These projections were computed from whole voxels. Half voxels predict them worse with the weight of whole
    voxels, and about as well with a smaller weight."""
    views, decide = measured(grains(), MORE_VIEWS), Decisions()
    tested = recon.reconstruct(views, MORE_VIEWS, recon.Discrete(), control=RunControl(decide=decide))
    (share,) = decide.made[HALVES]
    assert 0 < share < 1 and tested.settings["half_voxel_iterations"] > 0 and not tested.chosen

    def error(weight: float) -> float:
        followed = {**decide.made, HALVES: [weight], "still": [], "restart": []}
        control = RunControl(decide=Decisions(0, followed))
        volume = recon.reconstruct(views, MORE_VIEWS, recon.Discrete(), control=control).volume.data
        return float(np.sqrt(np.mean(np.square(volume - grains()))))

    assert error(share) < 0.98 * error(1)
    assert error(share) < 1.02 * error(0)  # whole voxels can be exact here


@pytest.mark.slow
@pytest.mark.parametrize("geometry", [VIEWS, MORE_VIEWS])
def test_smooth_matter_is_that_of_total_variation(geometry: recon.Geometry) -> None:
    data = measured(smooth(), geometry)
    found = recon.reconstruct(data, geometry, recon.Discrete())
    np.testing.assert_array_equal(found.volume.data, recon.reconstruct(data, geometry, recon.FistaTv()).volume.data)
    assert "levels_of_materials" not in found.settings
    assert found.chosen.startswith("this is the volume of fista-tv, because no discrete levels were found")
    assert recon.Discrete.probabilities(found.volume, found.settings) is None


@pytest.mark.slow
def test_auto_takes_it_for_grains_and_tries_neither_patches_nor_a_fit() -> None:
    candidates = recon.FistaTv(), recon.Discrete(), PnpDct(), recon.R2()
    found = recon.reconstruct(measured(grains()), VIEWS, recon.Auto(candidates))
    assert found.method == "discrete"
    assert all(f"{name} not tried" in found.settings["chosen_because"] for name in ("pnp-dct", "r2"))
    assert "levels_of_materials" in found.settings


@pytest.mark.slow
def test_auto_lists_no_residual_of_rejected_levels() -> None:
    """It would be that of fista-tv. A choice between other candidates needs it."""
    data = measured(smooth())
    beside, alone = (recon.reconstruct(data, VIEWS, recon.Auto(candidates)) for candidates in (
        (recon.FistaTv(), recon.Discrete()), (recon.Fbp(), recon.Discrete()),
    ))  # fmt: skip
    assert beside.method == "fista-tv" and "discrete 0." not in beside.settings["chosen_because"]
    assert beside.settings["chosen_because"].endswith(
        "; discrete: no levels were found that pass all tests with held-out projections"
    )
    assert alone.method == "discrete" and "; discrete 0." in alone.settings["chosen_because"]


@pytest.mark.slow
def test_the_finish_of_a_fit_pulls_to_them_too() -> None:
    made = [recon.reconstruct(measured(grains()), VIEWS, recon.R2(steps=60, finish=n)) for n in (None, 8)]
    assert [each.settings["refinement"] for each in made] == ["discrete", "fista-tv"]
    few, smooth = (error(each.volume.data, grains()) for each in made)
    assert few < 0.8 * smooth
    assert ["levels_of_materials" in each.settings for each in made] == [True, False]


@pytest.mark.slow
def test_another_slab_has_the_materials_of_the_first(of_grains: recon.Reconstruction) -> None:
    first, data = Decisions(), measured(grains())
    recon.reconstruct(data, VIEWS, recon.Discrete(), control=recon.RunControl(decide=first))
    control = recon.RunControl(decide=Decisions(0, first.made))
    other = recon.reconstruct(data[:, :3], VIEWS.rows(0, 3), recon.Discrete(), control=control)
    assert other.settings["levels_of_materials"] == of_grains.settings["levels_of_materials"]


@pytest.mark.slow
def test_levels_that_are_given_are_those_of_the_volume() -> None:
    found = recon.reconstruct(measured(grains()), VIEWS, recon.Discrete(levels=(0.015, 0.05)))
    np.testing.assert_allclose(found.settings["levels_of_materials"], (0.015, 0.05))


@pytest.mark.parametrize("levels", [(0.1,), (0.2, 0.1), (0.1, 0.1)])
def test_levels_that_do_not_ascend_are_refused(levels: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="in ascending order"):
        replace(recon.Discrete(), levels=levels)
