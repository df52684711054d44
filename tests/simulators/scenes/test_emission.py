"""Emission: counts of cylinders against chords by Pythagoras, and against the law that they are drawn from."""

from __future__ import annotations

import numpy as np
import pytest

from simulators.frame.shot import Detector
from simulators.scenes.emission import AIR, TEFLON, WATER, NemaPhantom, Rod, Scanner, events

DETECTOR = Detector.centred((4, 64), 1.0)
ANGLES = np.linspace(0, np.pi, 12, endpoint=False)
PLAIN = Scanner(trues=1e6, scatter=0.0, randoms=0.0, spread=0.0)


def _chord(radius: float, at: tuple[float, float], angle: float) -> np.ndarray:
    """mm of a cylinder on the three rays of each column, [ray, col]."""
    u = DETECTOR.u() + np.array([-1 / 3, 0, 1 / 3])[:, None] - at[0] * np.cos(angle) - at[1] * np.sin(angle)
    return 2 * np.sqrt(np.maximum(radius**2 - u**2, 0))


def test_lines_are_chords_of_the_cylinders() -> None:
    rods = {"hot": Rod(4.0, (10.0, 0.0), 4.0, WATER), "cold": Rod(5.0, (-8.0, 6.0), 0.0, TEFLON)}
    phantom = NemaPhantom(20.0, 30.0, rods)
    made = events(phantom, DETECTOR, ANGLES, PLAIN, seed=0)
    for view, angle in enumerate(ANGLES):
        body, hot, cold = (
            _chord(r, at, angle) for r, at in ((20.0, (0.0, 0.0)), (4.0, (10.0, 0.0)), (5.0, (-8.0, 6.0)))
        )
        depth = (WATER * body + (TEFLON - WATER) * cold).mean(axis=0)
        np.testing.assert_allclose(made.survival[view, 1], np.exp(-depth), rtol=1e-6)
        mean = made.scale * np.exp(-depth) * (body + 3 * hot - cold).mean(axis=0)
        assert np.abs(made.counts[view] - mean).max() < 6 * np.sqrt(mean.max())
    assert made.counts.sum() == pytest.approx(1e6, abs=5e3)  # 5 standard deviations
    assert not made.background.any() and (made.efficiency == 1).all()


@pytest.mark.slow
def test_counts_have_the_mean_and_the_variance_that_is_told() -> None:
    phantom, scanner = NemaPhantom(), Scanner(trues=2e5)
    drawn = [events(phantom, DETECTOR, ANGLES, scanner, seed) for seed in range(200)]
    one = drawn[0]
    assert one.efficiency.std() == pytest.approx(0.1, rel=0.2) and one.efficiency.mean() == pytest.approx(1, abs=0.03)
    assert one.background.sum() == pytest.approx(2e5 * 0.35, rel=0.03)
    rods = [(rod.radius, rod.at, rod.activity - 1) for rod in phantom.rods.values()]
    solids = [(phantom.radius, (0.0, 0.0), 1.0), *rods]
    lines = np.stack([sum(a * _chord(r, at, angle).mean(axis=0) for r, at, a in solids) for angle in ANGLES])[:, None]
    means = np.stack([each.scale * each.survival * lines + each.background for each in drawn])  # efficiency differs
    whitened = (np.stack([each.counts for each in drawn]) - means) / np.sqrt(means)
    assert whitened.mean() == pytest.approx(0, abs=4 / np.sqrt(whitened.size))
    assert whitened.std() == pytest.approx(1, abs=0.01)


def test_the_same_seed_gives_the_same_counts_and_a_cold_rod_has_its_own_attenuation() -> None:
    phantom = NemaPhantom()
    one, again, other = (events(phantom, DETECTOR, ANGLES, Scanner(), seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.counts, again.counts)
    assert (one.counts != other.counts).any()
    assert {name: rod.mu for name, rod in phantom.rods.items() if rod.activity == 0} == {"air": AIR, "teflon": TEFLON}
