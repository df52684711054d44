"""Battery: dense inside the field of view, light comes through, no particle in another, and the same with its seed."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.volume import Grid
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Box, Ellipsoid, Polyhedron
from simulators.samples.composed import ELECTROLYTE, PARTICLE, battery
from tests.refused_calls import refused_calls
from tests.simulators.bodies import volume


@pytest.mark.parametrize(("field", "seed"), [((0.9, 0.9), 0), ((0.72, 0.3), 1), ((2.0, 5.0), 2)])
def test_battery_is_dense_inside_the_field_and_lets_light_through(field: tuple[float, float], seed: int) -> None:
    solids = battery(np.random.default_rng(seed), field)
    assert len(solids) == 153
    phantom = Phantom.of(solids)
    detector = Detector.centred((120, 120), max(field) / 120)
    views = np.stack([phantom.line_integrals(a, detector) for a in np.linspace(0, np.pi, 20, endpoint=False)])
    assert 1.5 < views.max() < 3.0  # at least 5 % of the beam comes through
    outside = (np.abs(detector.u()) > field[0] * 0.45)[None, :] | (np.abs(detector.v()) > field[1] * 0.455)[:, None]
    assert outside[60, 0] or outside[0, 60]
    assert not views[:, outside].any()
    particles = solids[3:]
    share = sum(volume(p) for p in particles) / volume(solids[1])
    assert 0.08 < share < 0.16
    assert {type(p) for p in particles} == {Ellipsoid, Polyhedron, Box}
    sizes = np.cbrt([volume(p) for p in particles])
    assert sizes.max() > 1.8 * sizes.min()


def test_battery_s_particles_do_not_overlap() -> None:
    solids = battery(np.random.default_rng(5), (1.0, 1.0))
    truth = Phantom.of(solids[2:]).attenuation(Grid((110, 110, 110), 1 / 110))
    one = (ELECTROLYTE + PARTICLE) / 0.44
    assert truth.max() == pytest.approx(one)  # two particles in a voxel would make nearly twice that
    alone = Phantom.of(solids[3:]).attenuation(Grid((110, 110, 110), 1 / 110)).sum(dtype=np.float64) / 110**3
    assert alone == pytest.approx(sum(p.attenuation * volume(p) for p in solids[3:]), rel=2e-3)


def test_battery_repeats_with_its_seed_and_refuses_what_does_not_fit() -> None:
    assert battery(np.random.default_rng(4)) == battery(np.random.default_rng(4))
    assert battery(np.random.default_rng(4)) != battery(np.random.default_rng(5))
    assert len(battery(np.random.default_rng(4), n_particles=0)) == 3
    with pytest.raises(ValueError, match=r"lower fill.* 50 particles"):
        battery(np.random.default_rng(4), n_particles=50, fill=0.9)


test_calls_that_are_refused = refused_calls(__file__, globals())
