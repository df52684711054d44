"""Quantum efficiency: a share of the light, by value or by wavelength, and still Poisson."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from simulators.effects.quantum_efficiency import QuantumEfficiency
from simulators.frame import sensor
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


@pytest.mark.parametrize(
    ("effect", "share"),
    [
        ({"value": 0.25}, 0.25),
        ({"wavelength_nm": 300}, 0.5),
        ({"wavelength_nm": 450}, 0.85),
        ({"wavelength_nm": 535}, 0.73),  # between 0.80 at 500 and 0.70 at 550 nm
        ({"wavelength_nm": 1000}, 0.09),
        ({"path": {"absorbed": 0.25, "light": 100, "aperture": 0.6, "index": 1.0, "transmission": 0.5}}, 0.9125),
    ],
)
def test_a_share_of_the_light_is_detected(effect: dict[str, float], share: float) -> None:
    flat = shots.frame(shots.scene({"kind": "quantum_efficiency"} | effect), sample=False)
    assert (flat == round(4000 * share / CONVERSION)).all()


def test_thinned_light_is_poisson() -> None:
    """Counts of a thinned flat against the law of the thinned mean, by chi²; wrong once in a million seeds."""
    thin = QuantumEfficiency(0.7).apply(np.full((200, 250), 5.0), shots.shot())
    counts = np.random.default_rng(3).binomial(np.random.default_rng(4).poisson(5.0, thin.shape), 0.7)  # one by one
    direct = np.random.default_rng(5).poisson(thin)
    law = stats.poisson(3.5)
    expected = np.append(law.pmf(np.arange(11)), law.sf(10)) * thin.size
    for seen in (counts, direct):
        found = np.bincount(np.minimum(seen, 11).reshape(-1), minlength=12)
        assert ((found - expected) ** 2 / expected).sum() < stats.chi2.isf(1e-6, 11)
