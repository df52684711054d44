"""Foam: holes do not touch, are as large as fits, and fall in size; truth and labels are theirs; wrong ones refused."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest

from recon.base.volume import Grid
from simulators.frame.shot import Detector
from simulators.light import Beam
from simulators.samples.bodies.solids import Ellipsoid
from simulators.samples.builders.packed.foam import Foam, holes
from simulators.samples.composed import build_sample
from tests.refused_calls import refused_calls

SETTINGS: dict[str, Any] = {"n_holes": 400, "candidates": 20_000, "gap_um": 2.0}


def _balls(foam: Foam) -> np.ndarray:
    """(x, y, z, radius) of the holes."""
    holes = [piece.solid for piece in foam.pieces() if piece.role == "hole"]
    return np.array([(*hole.centre, hole.semi_axes[0]) for hole in holes if isinstance(hole, Ellipsoid)])


@pytest.mark.parametrize("edges", [None, (0.3, 0.4, 0.5)])
def test_holes_neither_touch_nor_leave_the_matter(edges: Any) -> None:
    foam = Foam(**SETTINGS, edges=edges)
    balls = _balls(foam)
    assert len(balls) == 400
    distance = np.linalg.norm(balls[:, None, :3] - balls[:, :3], axis=2) - balls[:, None, 3] - balls[:, 3]
    assert (distance + np.eye(400)).min() >= 0.002 * (1 - 1e-9)
    if edges is None:
        assert (np.hypot(balls[:, 0], balls[:, 1]) + balls[:, 3]).max() <= 0.3 - 0.002 + 1e-12
        assert (np.abs(balls[:, 2]) + balls[:, 3]).max() <= 0.25 - 0.002 + 1e-12
    else:
        assert (np.abs(balls[:, :3]) + balls[:, 3:] <= np.array(edges) / 2 - 0.002 + 1e-12).all()


def test_each_hole_is_the_largest_that_fits_at_any_candidate(rng: np.random.Generator) -> None:
    """Against the reference implementation: every candidate is checked for every hole."""
    points, room = rng.uniform(-0.5, 0.5, (2000, 3)), rng.uniform(0.02, 0.1, 2000)
    found = holes(points, room, 0.01, 0.003, 300)
    left, expected = room.copy(), list[Any]()
    while len(expected) < 300 and left.max() >= 0.01:
        i = int(left.argmax())
        expected.append((*points[i], left[i]))
        left = np.minimum(left, np.linalg.norm(points - points[i], axis=1) - left[i] - 0.003)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert (np.diff(found[:, 3]) <= 0).all()


def test_sizes_go_from_the_largest_down_to_the_smallest_that_is_allowed() -> None:
    foam = Foam(n_holes=100_000, candidates=5000, largest_um=80, smallest_um=20)
    radii = _balls(foam)[:, 3]
    assert radii[0] == pytest.approx(0.04) and radii[-1] >= 0.01
    assert 100 < len(radii) < 5000  # it ends where no more fit
    assert Foam(**SETTINGS).pieces() == Foam(**SETTINGS).pieces()
    assert Foam(**SETTINGS, seed=1).pieces() != Foam(**SETTINGS).pieces()


@pytest.mark.parametrize("edges", [(3e4, 3e4, 0.01), (1e8, 0.3, 0.3)])
def test_thin_and_flat_foams_cost_no_more_than_others(edges: tuple[float, float, float]) -> None:
    """Cells that points are sorted into are no more than the points: there were millions."""
    tracemalloc.start()
    balls = _balls(Foam(n_holes=50, candidates=2000, smallest_um=1.0, gap_um=0.0, edges=edges))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(balls) == 50
    assert peak < 5e6


def test_labels_and_mass_are_those_of_matter_less_holes() -> None:
    entry = {"kind": "foam", **SETTINGS, "attenuation": {"matter": 3.0}}
    sample = build_sample("phantom", entry, Beam(1e5))
    assert sample.names == ("matter", "hole")
    volume = (4 / 3 * np.pi * _balls(Foam(**SETTINGS))[:, 3] ** 3).sum()
    solid = np.pi * 0.3**2 * 0.5 - volume
    grid = Grid((104, 124, 124), 0.005)
    labels = sample.labels(grid)
    assert (labels == 2).sum() * 0.005**3 == pytest.approx(volume, rel=0.005)
    assert (labels == 1).sum() * 0.005**3 == pytest.approx(solid, rel=0.005)
    assert sample.attenuation(grid).sum(dtype=float) * 0.005**3 == pytest.approx(3 * solid, rel=0.002)
    seen = sample.line_integrals(0.7, Detector.centred((104, 124), 0.005))
    assert seen.sum() * 0.005**2 == pytest.approx(3 * solid, rel=0.005)


def test_in_a_beam_with_energies_holes_are_air() -> None:
    entry = {"kind": "foam", **SETTINGS, "made_of": {"matter": "Al"}}
    sample = build_sample("phantom", entry, Beam(1e5, energy_kev=20.0))
    grid = Grid((52, 62, 62), 0.01)
    labels, truth = sample.labels(grid), sample.attenuation(grid)
    # NIST, XCOM: aluminium has 3.441 cm2/g at 20 keV, and 2.699 g/cm3.
    assert np.median(truth[labels == 1]) == pytest.approx(3.441 * 0.2699, rel=0.01)
    assert 0 < truth[labels == 2].min() < 1e-3


test_calls_that_are_refused = refused_calls(__file__, globals())
