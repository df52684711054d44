"""Parts: contrasts, one energy as the plain path to the bit, and a mixture's depth and truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.volume import Grid
from simulators.frame.detector import Detector
from simulators.light.beam import Beam
from simulators.light.beam import Tube as XrayTube
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Box, Cylinder, Ellipsoid
from simulators.samples.materials.materials import of_formula
from simulators.samples.materials.parts import Mixture, Part, sample_of
from simulators.samples.materials.spectrum import Attenuation
from simulators.samples.sample import Sample

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


def test_a_tube_s_filters_are_known_by_name() -> None:
    from_list = sample_of(PARTS, Beam(1.0, tube=XrayTube(40.0, {"Al": 1.0})))
    thicker = sample_of(PARTS, Beam(1.0, tube=XrayTube(40.0, {"Al": 4.0})))
    assert isinstance(from_list, Mixture) and isinstance(thicker, Mixture)
    assert _depth(thicker).max() < 0.8 * _depth(from_list).max()


def test_labels_and_radius_are_those_of_the_parts() -> None:
    sample = _seen(PARTS, spectrum=((8.0, 1.0), (12.0, 2.0)))
    assert sample.names == ("liquid", "oxide", "label")
    assert sample.radius == 0.1
    z = Grid((1, 1, 3), 0.03, centre=(0.0, 0.02, 0.0))
    assert sample.labels(z)[0, 0].tolist() == [1, 1, 2]


def test_materials_are_refused_in_a_beam_without_energies_or_of_impossible_ones() -> None:
    with pytest.raises(ValueError, match="beam's"):
        _seen(PARTS)
    with pytest.raises(ValueError, match=r"from 0.1 to 800"):
        _seen(PARTS, energy_kev=900.0)
    with pytest.raises(ValueError, match="instead_of 'liquid'"):
        Part(BATH, instead_of=LIQUID)
