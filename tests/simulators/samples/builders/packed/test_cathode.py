"""Cathode: fill, sizes, habits, layers, pores and cracks as asked for, its parts and labels; wrong settings refused."""

from __future__ import annotations

import math
from typing import Any, get_args

import numpy as np
import pytest
from scipy.stats import kstest, truncnorm

from recon.base.volume import Grid
from simulators.light import Beam
from simulators.samples.bodies.solids import Ellipsoid, Polyhedron
from simulators.samples.builders.packed.cathode import (
    GREY,
    Cathode,
    Habit,
    Sizes,
    core,
    crack,
    grain,
    grains,
    inner_radius,
)
from simulators.samples.composed import build_sample
from simulators.samples.materials.materials import known
from tests.refused_calls import refused_calls
from tests.simulators.bodies import volume
from tests.simulators.samples.builders.packed.test_arrangement import corners, overlapping, spread

SMALL: dict[str, Any] = {"diameter": 0.2, "height": 0.15, "wall_um": 10, "size_um": 25, "fill": 0.3}
FALSE_ALARM = 1e-6


def _of(cathode: Cathode, role: str) -> list[Any]:
    return [piece.solid for piece in cathode.pieces() if piece.role == role]


def test_grains_reach_the_requested_fill_without_overlap() -> None:
    cathode = Cathode(**SMALL, separator_um=10, collector_um=20)
    found = _of(cathode, "particle")
    room = math.pi * 0.09**2 * (0.15 - 0.03)
    assert sum(volume(solid) for solid in found) / room == pytest.approx(0.3, rel=0.02)
    assert overlapping(found) == []
    heights = [solid.centre[2] for solid in found]
    assert -0.055 < min(heights) < -0.04 and 0.05 < max(heights) < 0.065  # between foil and film
    assert cathode.pieces() == cathode.pieces()
    assert _of(Cathode(**SMALL, seed=1), "particle") != _of(Cathode(**SMALL), "particle")


def test_sizes_are_log_normal(rng: np.random.Generator) -> None:
    """Kolmogorov and Smirnov's test against the normal distribution cut off at 2.5, once in 1e6 by chance."""
    drawn = grains(rng, 2000 * math.pi / 6 * 0.02**3, Sizes(0.02, 0.3), {"sphere": 1.0, "plate": 2.0}, 0.1, 3.0)
    diameters = np.array([(6 * volume(solid) / math.pi) ** (1 / 3) for solid in drawn])
    deviations = np.log(diameters / 0.02) / 0.3
    assert len(drawn) > 1000
    assert kstest(deviations, truncnorm(-2.5, 2.5).cdf).pvalue > FALSE_ALARM
    assert kstest(deviations * 1.3, truncnorm(-2.5, 2.5).cdf).pvalue < FALSE_ALARM  # it would tell


def test_habits_have_their_shares(rng: np.random.Generator) -> None:
    drawn = grains(rng, 2000 * math.pi / 6 * 0.02**3, Sizes(0.02, 0.0), {"octahedron": 3.0, "plate": 1.0}, 0.0, 3.0)
    assert abs(len(drawn) - 2000) <= 1
    plates = sum(isinstance(solid, Polyhedron) and len(solid.vertices) == 12 for solid in drawn)
    # Binomial with a standard deviation of 19.4: 4.9 of them are exceeded once in 1e6.
    assert abs(plates - 500) < 4.9 * math.sqrt(2000 * 0.25 * 0.75)


@pytest.mark.parametrize("habit", get_args(Habit))
def test_grains_have_the_volume_of_their_sphere_and_hold_their_pores_and_cracks(
    habit: Habit, rng: np.random.Generator
) -> None:
    for _ in range(20):
        solid = grain(rng, habit, 0.02, 0.3, 3.0)
        assert volume(solid) == pytest.approx(math.pi / 6 * 0.02**3, rel=1e-12)
        assert volume(core(solid)) == pytest.approx(volume(solid) / 8, rel=1e-12)
        flat = crack(rng, solid)
        assert max(flat.semi_axes) < inner_radius(solid)
        ball = rng.normal(size=(300, 3))
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
        radius = inner_radius(solid)
        if isinstance(solid, Ellipsoid):
            assert (np.linalg.norm(np.linalg.solve(spread(solid), radius * ball.T), axis=0) <= 1 + 1e-9).all()
        else:  # the sphere inside reaches no farther than the hull in any direction
            assert ((corners(solid) @ ball.T).max(axis=0) >= radius * (1 - 1e-9)).all()


def test_some_grains_are_hollow_and_some_cracked() -> None:
    cathode = Cathode(**SMALL, hollow=0.3, cracked=0.3)
    n, hollow, cracked = (len(_of(cathode, role)) for role in ("particle", "pore", "crack"))
    limit = 4.9 * math.sqrt(n * 0.3 * 0.7)
    assert abs(hollow - 0.3 * n) < limit and abs(cracked - 0.3 * n) < limit
    assert hollow and cracked


def test_labels_and_truth_are_those_of_the_solids() -> None:
    entry = {"kind": "cathode", **SMALL, "hollow": 0.5, "separator_um": 15, "collector_um": 15, "habits": {"sphere": 1}}
    sample = build_sample("phantom", entry, Beam(1e5))
    assert sample.names == ("wall", "electrolyte", "collector", "separator", "particle", "pore")
    grid = Grid((64, 84, 84), 0.0025)
    labels, truth = sample.labels(grid), sample.attenuation(grid)
    cathode = Cathode(**SMALL, hollow=0.5, separator_um=15, collector_um=15, habits={"sphere": 1.0})
    for role in ("particle", "pore"):
        filled = sum(volume(solid) for solid in _of(cathode, role))
        filled -= sum(volume(solid) for solid in _of(cathode, "pore")) if role == "particle" else 0
        counted = (labels == sample.names.index(role) + 1).sum() * grid.voxel_size**3
        assert counted == pytest.approx(filled, rel=0.01)
        # Well inside, voxels have the grey of what they are.
        inside = np.isin(labels, sample.names.index(role) + 1)
        assert np.median(truth[inside]) == pytest.approx(GREY[role] / 0.1, rel=1e-5)
    assert truth.max() == pytest.approx(GREY["particle"] / 0.1, rel=1e-5)


def test_in_a_beam_with_energies_parts_are_materials() -> None:
    entry = {"kind": "cathode", **SMALL, "made_of": {"particle": "NMC622", "wall": "steel"}, "habits": {"sphere": 1}}
    sample = build_sample("phantom", entry, Beam(1e5, energy_kev=25.0))
    grid = Grid((64, 84, 84), 0.0025)
    labels, truth = sample.labels(grid), sample.attenuation(grid)
    for role, name in (("particle", "NMC622"), ("wall", "steel"), ("electrolyte", "electrolyte")):
        material = known(name)
        assert material is not None
        inside = labels == sample.names.index(role) + 1
        assert np.median(truth[inside]) == pytest.approx(float(material.attenuation(25.0)), rel=1e-5)


test_calls_that_are_refused = refused_calls(__file__, globals())
