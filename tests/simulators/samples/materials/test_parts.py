"""Parts: solids of materials, the sample that they form, and what a beam of many energies sees of it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from recon.base.volume import Grid
from simulators.frame.shot import Detector
from simulators.light import Beam
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Box, Cylinder, Ellipsoid
from simulators.samples.materials.materials import of_formula, palette_of
from simulators.samples.materials.parts import Mixture, Part, effective_depth, sample_of
from simulators.samples.materials.spectrum import Attenuation
from simulators.samples.sample import Sample
from simulators.scenes.scene import load_scene
from tests.refused_calls import refused_calls

LIQUID, OXIDE = of_formula("liquid", "C3H6O3", 1.3), of_formula("oxide", "LiCoO2", 5.05)
BATH = Cylinder(0.1, 0.3, 1.0)
GRAIN = Ellipsoid((0.01, 0.012, 0.015), 1.0, (0.03, 0.02, 0.0))
PARTS = (
    Part(BATH, LIQUID),
    Part(GRAIN, OXIDE, LIQUID),
    Part(Box((0.1, 0.02, 0.1), 2.0), name="label"),
    Part(replace(GRAIN, centre=(-0.03, 0.02, 0.05)), OXIDE, LIQUID),
)
DETECTOR = Detector.centred((40, 50), 0.005)


def _no_filters(name: str) -> Attenuation:
    raise AssertionError(f"nobody named {name}")


def _seen(parts: Sequence[Part], **light: Any) -> Sample:
    return sample_of(parts, Beam(1.0, **light), _no_filters)


def _depth(sample: Sample) -> NDArray[np.float64]:
    return sample.line_integrals(0.4, DETECTOR)


def test_one_energy_is_the_plain_phantom_to_the_bit() -> None:
    liquid, oxide = float(LIQUID.attenuation(8.0)), float(OXIDE.attenuation(8.0))
    plain = Phantom.of(
        [
            replace(BATH, attenuation=liquid),
            replace(GRAIN, attenuation=oxide - liquid),
            PARTS[2].solid,
            replace(PARTS[3].solid, attenuation=oxide - liquid),
        ]
    )
    expected = _depth(plain)
    for light in ({"energy_kev": 8.0}, {"spectrum": ((8.0, 0.3),)}):
        sample = _seen(PARTS, **light)
        assert isinstance(sample, Phantom)
        np.testing.assert_array_equal(_depth(sample), expected)
    same = _seen(PARTS, spectrum=((8.0, 0.3), (8.0, 0.7)))
    assert isinstance(same, Mixture)
    np.testing.assert_allclose(_depth(same), expected, atol=1e-12)


def test_grey_parts_ask_nobody_for_energies() -> None:
    sample = _seen([PARTS[2], Part(BATH)])
    np.testing.assert_array_equal(_depth(sample), _depth(Phantom.of([PARTS[2].solid, BATH])))
    assert sample.names == ("label", "cylinder")


def test_a_slab_under_two_energies_is_the_closed_form() -> None:
    """A box of 0.05 mm behind 0.1 mm of a grey one: exp(-grey) sum_e w_e exp(-mu_e t)."""
    parts = [Part(Box((9.0, 0.05, 9.0), 1.0), OXIDE), Part(Box((9.0, 0.1, 9.0), 3.0, (0.0, 1.0, 0.0)))]
    sample = _seen(parts, spectrum=((8.0, 1.0), (16.0, 3.0)))
    low, high = OXIDE.attenuation([8.0, 16.0])
    expected = 0.3 - np.log(0.25 * np.exp(-0.05 * low) + 0.75 * np.exp(-0.05 * high))
    np.testing.assert_allclose(sample.line_integrals(0.0, DETECTOR), expected, rtol=1e-12)


def test_what_is_displaced_is_not_there_any_more() -> None:
    """A grain in a bath, against a bath with a hole and a grain in the hole: what does not overlap."""
    grain = replace(BATH, radius=0.04)
    displaced = _seen([Part(BATH, LIQUID), Part(grain, OXIDE, LIQUID)], spectrum=((8.0, 1.0), (12.0, 2.0)))
    hole = Part(replace(grain, attenuation=-1.0), LIQUID)
    apart = _seen([Part(BATH, LIQUID), hole, Part(grain, OXIDE)], spectrum=((8.0, 1.0), (12.0, 2.0)))
    np.testing.assert_allclose(_depth(displaced), _depth(apart), atol=1e-12)


def test_a_share_of_a_volume_attenuates_by_its_share() -> None:
    half = _seen([Part(replace(BATH, attenuation=0.5), OXIDE)], energy_kev=9.0)
    np.testing.assert_allclose(_depth(half), 0.5 * _depth(_seen([Part(BATH, OXIDE)], energy_kev=9.0)))


def test_the_truth_is_the_thin_limit_and_depths_never_exceed_it() -> None:
    light = {"spectrum": ((8.0, 1.0), (12.0, 2.0), (24.0, 0.1))}
    thick = _seen(PARTS, **light)
    assert isinstance(thick, Mixture)
    mean = np.array([1.0, 2.0, 0.1]) @ LIQUID.attenuation([8.0, 12.0, 24.0]) / 3.1
    grid = Grid((1, 1, 1), 0.01, centre=(0.1, -0.05, 0.0))
    assert thick.attenuation(grid)[0, 0, 0] == pytest.approx(mean, rel=1e-6)
    effective, in_the_limit = _depth(thick), _depth(thick.whole)
    assert (effective <= in_the_limit + 1e-12).all()
    assert (in_the_limit - effective).max() > 0.01  # hardening
    thin = [replace(part, solid=replace(part.solid, attenuation=1e-4 * part.solid.attenuation)) for part in PARTS]
    sample = _seen(thin, **light)
    assert isinstance(sample, Mixture)
    np.testing.assert_allclose(_depth(sample), _depth(sample.whole), rtol=2e-4)


def test_labels_and_radius_are_those_of_the_parts() -> None:
    sample = _seen(PARTS, spectrum=((8.0, 1.0), (12.0, 2.0)))
    assert sample.names == ("liquid", "oxide", "label")
    assert sample.radius == 0.1
    z = Grid((1, 1, 3), 0.03, centre=(0.0, 0.02, 0.0))
    assert sample.labels(z)[0, 0].tolist() == [1, 1, 2]


POOL = {"kind": "cylinder", "radius": 0.1, "height": 0.3, "material": "electrolyte"}
OXIDE_GRAIN = {
    "kind": "ellipsoid", "semi_axes": [0.01, 0.01, 0.01], "material": "NMC811", "instead_of": "electrolyte",
    "name": "active",
}  # fmt: skip
GREY = {"kind": "box", "edges": [0.1, 0.02, 0.1], "attenuation": 2.0, "name": "wall"}


def _sample(*solids: Any, materials: Any = None, **light: Any) -> Sample:
    phantom = {"kind": "solids", "solids": list(solids)} | ({} if materials is None else {"materials": materials})
    return load_scene({"phantom": phantom, "beam": {"photons_per_s": 1.0} | light}).sample


def test_a_scene_s_grain_stands_out_by_its_contrast() -> None:
    charged = {"NMC811": {"state_of_charge": 1.0}}
    sample = _sample(POOL, OXIDE_GRAIN, GREY, materials=charged, energy_kev=8.3485)
    assert sample.names == ("electrolyte", "active", "wall")
    centre = sample.line_integrals(0.0, Detector.centred((1, 1), 0.01))[0, 0]
    colours = palette_of("", charged)
    oxide, bath = (float(colours(name).attenuation(8.3485)) for name in ("NMC811", "electrolyte"))
    assert centre == pytest.approx(0.2 * bath + 0.02 * (oxide - bath) + 0.02 * 2.0)


def test_a_tube_s_filters_may_be_the_scene_s_own_materials() -> None:
    tube = {"tube": {"kv": 40, "filters": {"foil": 0.5}}}
    hard = _sample(POOL, materials={"foil": {"formula": "Cu", "density": 8.96}}, **tube)
    soft = _sample(POOL, materials={"foil": {"formula": "C", "density": 0.1}}, **tube)
    at = Detector.centred((1, 1), 0.01)
    assert 0 < hard.line_integrals(0.0, at)[0, 0] < 0.2 * soft.line_integrals(0.0, at)[0, 0]


def test_tables_are_loaded_only_where_a_material_is_named() -> None:
    code = (
        "import sys; from simulators.scenes.scene import load_scene; solid = {'kind': 'box', 'edges': [1, 1, 1]};"
        "load_scene({'phantom': {'kind': 'solids', 'solids': [solid | {'attenuation': 1}]}, 'beam': "
        "{'photons_per_s': 1, 'energy_kev': 8}}); assert 'xraylib' not in sys.modules;"
        "load_scene({'phantom': {'kind': 'solids', 'solids': [solid | {'material': 'Al'}]}, 'beam': "
        "{'photons_per_s': 1, 'energy_kev': 8}}); assert 'xraylib' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


Reals = NDArray[np.float64]


@given(
    thickness=arrays(np.float64, (2, 3, 4), elements=st.floats(0, 50)),
    mu=arrays(np.float64, (3, 2), elements=st.floats(-0.5, 60)),
    weights=arrays(np.float64, 3, elements=st.floats(0.01, 1)),
)
def test_the_effective_depth_lies_between_the_least_and_the_mean(thickness: Reals, mu: Reals, weights: Reals) -> None:
    """Jensen: light that is added up never looks deeper than the mean depth; matter of one attenuation is exact."""
    weights = weights / weights.sum()
    depths = np.tensordot(mu, thickness, 1)
    got = effective_depth(thickness, mu, weights)
    slack = 1e-9 * (1 + np.abs(depths).max())
    assert (got <= np.tensordot(weights, depths, 1) + slack).all()
    assert (got >= depths.min(axis=0) - slack).all()
    same = effective_depth(thickness, np.repeat(mu[:1], 3, axis=0), weights)
    np.testing.assert_allclose(same, depths[0], atol=slack)


def test_air_is_exactly_nothing_and_no_matter_is_too_deep() -> None:
    thickness = np.zeros((1, 2, 2))
    thickness[0, 1] = 1e6
    depth = effective_depth(thickness, np.array([[5.0], [4.0]]), np.array([0.3, 0.7]))
    assert (depth[0] == 0).all() and np.isfinite(depth[1]).all()
    gap = np.array([[[1.0, 0.0, 1.0]]])  # between matter, where weights sum up to 1 only to rounding
    assert effective_depth(gap, np.ones((10, 1)), np.full(10, 0.1))[0, 1] == 0.0


def test_many_rows_are_shared_out_and_come_out_the_same() -> None:
    thickness = np.random.default_rng(0).uniform(0, 2, (2, 300, 301))  # more than threads are taken for
    mu, weights = np.array([[3.0, 1.0], [1.0, 2.0]]), np.array([0.4, 0.6])
    expected = -np.log(np.tensordot(weights, np.exp(-np.tensordot(mu, thickness, 1)), 1))
    np.testing.assert_allclose(effective_depth(thickness, mu, weights), expected, rtol=1e-12)


test_calls_that_are_refused = refused_calls(__file__, globals())
