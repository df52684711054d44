"""Beam hardening of simulated scans of known attenuation: cupping goes, whether the beam is stated or fitted."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from beamline.projections.corrections.beam_hardening.hardening import Hardening, curve_of
from beamline.projections.selection import Selection
from recon.base.geometry import Geometry
from simulators.effects.beam.energies import BeamHardening
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Box, Cylinder
from tests.beamline.array_source import ArraySource
from tests.beamline.prepared_views import prepare
from tests.simulators import shots

pytestmark = pytest.mark.usefixtures("one_thread")
SHAPE, ATTENUATION = (2, 100), 0.02
GEOMETRY = Geometry.parallel(np.linspace(0, np.pi, 90, endpoint=False), SHAPE, pixel_pitch=1.0, axis_col=49.5)
ENERGIES = (20.0, 30.0, 45.0)
STATED = Hardening("stated", (np.array(ENERGIES) ** -3, np.ones(3)))
F32 = NDArray[np.float32]


def _views(sample: Phantom, energies: tuple[float, ...] = ENERGIES) -> F32:
    rng, detector = np.random.default_rng(0), Detector(SHAPE, 1.0, 49.5, 0.5)
    hardening = BeamHardening((1.0,) * len(energies), energies=energies)
    depths = [sample.line_integrals(angle, detector).astype(np.float64) for angle in GEOMETRY.angles]
    seen = np.stack([hardening.apply(depth.copy(), shots.shot(detector=detector)) for depth in depths])
    return (-np.log(rng.poisson(1e5 * np.exp(-seen)) / 1e5)).astype(np.float32)


ROD = Phantom.of((Cylinder(34.0, 8.0, ATTENUATION), Cylinder(5.0, 8.0, -ATTENUATION, centre=(15.0, 8.0, 0.0))))


@pytest.mark.parametrize(("wanted", "within"), [(STATED, 0.02), (Hardening("fit"), 0.12)])
@pytest.mark.parametrize("sample", [ROD, Phantom.of((Box((60.0, 16.0, 8.0), ATTENUATION),))])
def test_a_body_is_as_dense_inside_as_near_its_surface(sample: Phantom, wanted: Hardening, within: float) -> None:
    views = _views(sample)
    curve, said = curve_of(views, GEOMETRY, wanted)
    assert curve is not None and "line integrals of" in said
    before = recon.reconstruct(views, GEOMETRY, "fbp").volume.data[0]
    curve.linearise(views)
    after = recon.reconstruct(views, GEOMETRY, "fbp").volume.data[0]
    middle, outside = (slice(46, 54), slice(42, 58)), (slice(46, 54), slice(22, 28))  # of the body; no hole is there
    assert after[middle].mean() == pytest.approx(ATTENUATION, rel=within)  # few rays are thin enough to fix the scale
    assert after[middle].mean() == pytest.approx(after[outside].mean(), rel=0.03)
    assert before[middle].mean() < 0.88 * before[outside].mean()


def test_hardening_that_nobody_asked_to_correct_is_said_where_the_masses_show_it() -> None:
    bar = Phantom.of((Box((60.0, 16.0, 8.0), ATTENUATION), Cylinder(5.0, 8.0, ATTENUATION, centre=(15.0, 18.0, 0.0))))
    said = {}
    for energies in (ENERGIES, (30.0,)):
        source = ArraySource(views := _views(bar, energies), [0] * len(views), GEOMETRY.angles)
        source.quantity = "line_integrals"
        scan, _ = prepare(source, Selection(axis_col=49.5))
        said[energies] = scan.origin.done["hardening"].sentence
        np.testing.assert_array_equal(scan.seen.data, views)
    assert "give --hardening fit" in said[ENERGIES] and not said[(30.0,)]


def test_one_energy_and_two_materials_are_left_as_they_are() -> None:
    curve, said = curve_of(_views(ROD, (30.0,)), GEOMETRY, Hardening("fit"))
    assert curve is None and "none was found" in said
    two = Phantom.of((Cylinder(34.0, 8.0, 0.01), Cylinder(6.0, 8.0, 0.1, centre=(15.0, 8.0, 0.0))))
    curve, said = curve_of(_views(two), GEOMETRY, Hardening("fit"))
    assert curve is None and "the projections do not determine the curve (the sample seems to have several" in said


def test_a_body_denser_outside_is_no_hardening_and_a_cone_takes_a_stated_beam() -> None:
    shell = Phantom.of((Box((60.0, 40.0, 8.0), 0.03), Box((48.0, 28.0, 8.0), -0.012)))
    curve, said = curve_of(_views(shell, (30.0,)), GEOMETRY, Hardening("fit"))
    assert curve is None and "agree less with each other" in said, said
    cone = Geometry.cone(GEOMETRY.angles, SHAPE, 1.0, 400.0, 500.0, axis_col=49.5)
    curve, said = curve_of(_views(ROD), cone, Hardening("fit"))
    assert curve is None and "parallel beam" in said
    assert curve_of(_views(ROD), cone, STATED)[0] is not None
