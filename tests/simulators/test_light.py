"""Light: all effects of light together are linear in the exposure, and a flat takes out what does not depend on it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from simulators.effects.catalogue import Domain
from simulators.frame.shot import Shot
from simulators.scenes.scene import Scene
from tests.simulators import shots

DEPTH: list[Any] = [
    {"kind": "phase_fringes", "delta_beta": 2.0, "distance": 300.0, "energy": 20.0},
    {"kind": "harmonics", "share": 0.02},
    {"kind": "beam_hardening", "weights": [2, 1], "energies": [18, 25]},
]
PHOTONS: list[Any] = [
    {"kind": "beam_profile", "sigma": [0.4, 0.3], "stripes": 0.1, "wander_speed": [1e-4, 0.0]},
    {"kind": "scatter", "ratio": 0.1, "width_mm": 0.2, "background": 500.0},
    {"kind": "scintillator_blur", "fwhm_um": 20.0, "tail_share": 0.1, "tail_um": 80.0},
    {"kind": "flat_structure", "specks": 300, "radius_um": 500.0},
    {"kind": "quantum_efficiency", "wavelength_nm": 535.0},
]


def _photons(scene: Scene, shot: Shot, open_beam: float) -> NDArray[np.float64]:
    """Expectation behind the sample, before digitising."""
    depth = scene.chain.apply(Domain.OPTICAL_DEPTH, shots.depth(scene, 0.4), shot)
    return scene.chain.apply(Domain.PHOTONS, open_beam * shot.exposure * np.exp(-depth), shot)


@settings(max_examples=10)
@given(factor=st.floats(0.01, 100), flux=st.floats(0.0, 1e6))
def test_light_is_linear_in_the_exposure(factor: float, flux: float) -> None:
    scene = shots.scene(*DEPTH, *PHOTONS)
    short = shots.shot()
    long = replace(short, exposure=factor * short.exposure)
    np.testing.assert_allclose(_photons(scene, long, flux), factor * _photons(scene, short, flux), rtol=1e-10)


def test_no_light_is_made_by_depth_effects_in_air_or_lost_by_blur() -> None:
    """Air stays air, and the blur preserves the sum of light after scatter and profile."""
    air = shots.scene(*DEPTH, phantom={"kind": "solids", "solids": []})
    np.testing.assert_allclose(_photons(air, shots.shot(), 1e5), 1000.0, rtol=1e-5)
    without = shots.scene(*DEPTH, *PHOTONS[:2])
    blurred = shots.scene(*DEPTH, *PHOTONS[:3])
    sums = [_photons(scene, shots.shot(), 1e5).sum() for scene in (without, blurred)]
    assert sums[1] == pytest.approx(sums[0], rel=1e-12)
