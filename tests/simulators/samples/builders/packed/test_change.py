"""Samples that change: a foam settles and particles charge as their laws say; frames show the sample of their time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from recon.base.volume import Grid
from simulators.frame.shot import Detector
from simulators.light import Beam
from simulators.samples.bodies.solids import Cylinder, Ellipsoid
from simulators.samples.builders.packed.foam import Foam
from simulators.samples.builders.packed.pieces import Charge, Settle
from simulators.samples.sample import sample_at
from simulators.scenes.expose import expose
from simulators.scenes.scene import load_scene
from tests.refused_calls import refused_calls
from tests.simulators.shots import shot

FOAM = {"kind": "foam", "n_holes": 60, "candidates": 4000, "smallest_um": 30.0, "largest_um": 120.0, "gap_um": 3.0}
SETTLE = {"kind": "settle", "share": 0.3, "from_s": 2.0, "over_s": 5.0}
CELL = {"kind": "cathode", "size_um": 80.0, "fill": 0.2}
GREY = Beam(photons_per_s=1e5)


def test_heights_and_holes_settle_exponentially_and_holes_never_touch() -> None:
    first = Foam(n_holes=60, candidates=4000, smallest_um=30, largest_um=120, gap_um=3).pieces()
    change = Settle(share=0.3, from_s=2.0, over_s=5.0)
    assert change.at(first, 1.0) == first
    later = change.at(first, 7.0)
    left = 1 - 0.3 * (1 - np.exp(-1))
    matter, before = later[0].solid, first[0].solid
    assert isinstance(matter, Cylinder) and isinstance(before, Cylinder)
    assert matter.height == pytest.approx(left * before.height)
    assert matter.centre[2] - matter.height / 2 == pytest.approx(-before.height / 2)
    holes = [piece.solid for piece in later if isinstance(piece.solid, Ellipsoid)]
    at, radius = np.array([hole.centre for hole in holes]), np.array([hole.semi_axes[0] for hole in holes])
    apart = np.linalg.norm(at[:, None] - at, axis=2) - radius[:, None] - radius + np.eye(len(holes))
    assert apart.min() >= left * 0.003 * (1 - 1e-9)


def test_particles_charge_one_after_the_other_and_nothing_else_does() -> None:
    change = Charge(factor=0.5, from_s=1.0, over_s=4.0, each_s=0.01, seed=3)
    first = build_pieces()
    found = {}
    for seconds in (0.0, 3.0, 9.0):
        later = change.at(first, seconds)
        assert [p for p in later if p.role != "particle"] == [p for p in first if p.role != "particle"]
        found[seconds] = np.array([p.solid.attenuation for p in later if p.role == "particle"])
    np.testing.assert_allclose(found[0.0], 1, atol=1e-6)
    np.testing.assert_allclose(found[9.0], 0.5, atol=1e-6)
    assert 0.3 < (found[3.0] > 0.75).mean() < 0.7  # half of them have changed


def build_pieces() -> Any:
    from simulators.samples.builders.packed.cathode import Cathode

    return Cathode(size_um=80.0, fill=0.2).pieces()


@pytest.mark.parametrize("phantom", [FOAM | {"change": SETTLE}, CELL | {"change": {"kind": "charge", "over_s": 8.0}}])
def test_a_frame_shows_the_sample_of_its_time(phantom: dict[str, Any]) -> None:
    """The mass that rays see is that of the truth at this time, which is computed in another way."""
    scene = load_scene({"phantom": phantom, "beam": {"photons_per_s": 1e9}})
    masses = []
    for elapsed in (0.0, 6.0):
        detector = Detector.centred((140, 140), 0.005)
        conditions = shot(detector=detector, exposure=1.0, elapsed=elapsed, conversion=1e5)
        depth = -np.log(np.maximum(expose(scene, conditions), 1) * conditions.conversion / 1e9)
        grid = Grid((140, 140, 140), 0.005)
        truth = sample_at(scene.sample, elapsed).attenuation(grid)
        masses.append(depth.sum() * 0.005**2)
        assert masses[-1] == pytest.approx(float(truth.sum(dtype=np.float64)) * 0.005**3, rel=0.01)
    assert masses[1] < 0.97 * masses[0]


test_calls_that_are_refused = refused_calls(__file__, globals())
