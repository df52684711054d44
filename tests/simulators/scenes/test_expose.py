"""Exposure without effects: Beer-Lambert, on any number of threads."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from simulators.effects.chain import Chain
from simulators.frame.detector import Detector
from simulators.frame.pose import Pose
from simulators.light.beam import Beam
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid
from simulators.samples.sample import Sample
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene
from tests.simulators import shots
from tests.simulators.bodies import SOLIDS

ALL = Phantom.of(list(SOLIDS.values()))


def _scene(sample: Sample, photons_per_s: float = 4e5) -> Scene:
    return Scene(sample=sample, beam=Beam(photons_per_s), chain=Chain.of([]))


def test_a_frame_without_effects_is_beer_lambert_rounded_and_clipped() -> None:
    """From amplified light to where the exponential underflows."""
    for attenuation in (-500.0, -3.0, 0.0, 3.0, 1400.0, 1e6):
        sample = Phantom.of([Ellipsoid((0.3, 0.2, 0.25), attenuation), Cylinder(0.35, 0.3, attenuation)])
        shot = shots.shot(angle=0.3)
        with np.errstate(over="ignore"):
            light = 4e5 * shot.exposure * shot.binning**2 * np.exp(-sample.line_integrals(0.3, shot.detector))
            counts = expose(_scene(sample), shot)
        np.testing.assert_array_equal(counts, np.rint(np.minimum(light / shot.conversion, 65535)))


def test_the_steps_that_were_taken_are_told() -> None:
    steps: list[str] = []

    def on_step(step: str) -> AbstractContextManager[None]:
        steps.append(step)
        return nullcontext()

    expose(_scene(ALL), shots.shot(), on_step)
    assert steps == ["line_integrals", "beer_lambert", "digitise", "digitise"]


def test_darks_and_flats_are_not_the_sample_s() -> None:
    scene = _scene(ALL)
    assert not expose(scene, replace(shots.shot(), beam=False)).any()
    assert len(np.unique(expose(scene, replace(shots.shot(), sample=False)))) == 1


@pytest.mark.parametrize("threads", [2, 3, 7])
@pytest.mark.parametrize("sod", [math.inf, 2.0])
def test_threads_change_no_bit(threads: int, sod: float, monkeypatch: pytest.MonkeyPatch) -> None:
    detector = Detector((300, 310), 0.004, 150.2, 144.4, sod)
    pose = Pose.turned(np.linspace(0.2, 0.3, 300), 300)

    def frames() -> list[NDArray[Any]]:
        counts = expose(_scene(ALL), shots.shot(detector=detector))
        return [counts, ALL.line_integrals(0.7, detector), ALL.line_integrals(pose, detector)]

    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 1)
    alone = frames()
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
    for one, many in zip(alone, frames(), strict=True):
        np.testing.assert_array_equal(one, many)
