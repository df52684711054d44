"""Exposure without effects: in one pass over the rows or step by step, to the same count, on any number of threads."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from simulators.effects.chain import Chain
from simulators.frame.detector import Detector
from simulators.frame.pose import Pose
from simulators.light.beam import Beam
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Box, Cylinder, Ellipsoid, Solid
from simulators.samples.builders.battery import battery
from simulators.samples.sample import Counted, Sample
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene
from tests.simulators import shots
from tests.simulators.bodies import SOLIDS

ALL = Phantom.of(list(SOLIDS.values()))


def _scene(sample: Sample, photons_per_s: float = 4e5) -> Scene:
    return Scene(sample=sample, beam=Beam(photons_per_s), chain=Chain.of([]))


def _both(scene: Scene, **changes: Any) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    shot = shots.shot(**changes)
    return expose(scene, shot), expose(replace(scene, sample=_Plain(scene.sample)), shot)


@pytest.mark.parametrize("sod", [math.inf, 1.5])
@settings(max_examples=20, deadline=None)
@given(
    angle=st.floats(-7, 7),
    light=st.floats(0, 1e7),
    exposure=st.sampled_from([1e-4, 0.01, 0.3]),
    binning=st.sampled_from([1, 2, 4]),
)
def test_in_one_go_and_step_by_step_are_the_same(
    sod: float, angle: float, light: float, exposure: float, binning: int
) -> None:
    """From darkness to saturation."""
    detector = Detector((50, 70), 0.02, 33.3, 21.7, sod)
    at_once, steps = _both(
        _scene(ALL, light), angle=angle, detector=detector, exposure=exposure, binning=binning
    )  # fmt: skip
    np.testing.assert_array_equal(at_once, steps)


@pytest.mark.parametrize("n", [0, 40, 400])
def test_large_frames_are_the_same_too(n: int) -> None:
    """Many counts, many solids, full range: 700 thousand pixels."""
    scene = _scene(Phantom.of(battery(np.random.default_rng(n), (0.9, 0.9), n, fill=0.1)), 6.9e5)
    at_once, steps = _both(scene, detector=Detector((800, 900), 1e-3, 444.2, 401.3))
    np.testing.assert_array_equal(at_once, steps)
    assert steps.max() > 60_000


def test_counts_in_the_very_middle_are_rounded_as_the_rule_does() -> None:
    """Open beam x exp(-depth) a hair from a half over the whole frame: a polynomial alone would toss a coin there."""
    for k in range(200, 240):
        for solid in (Box((9.0, 0.5, 9.0), 1.0), Cylinder(0.3, 9.0, 1e-18), Ellipsoid((9e3, 0.25, 9e3), 1.0)):
            open_beam = (k + 0.5) * (1.0 if isinstance(solid, Cylinder) else math.exp(0.5))
            at_once, steps = _both(_scene(Phantom.of([solid]), open_beam), exposure=1.0, conversion=1.0, angle=0.0)
            np.testing.assert_array_equal(at_once, steps)


def test_deep_shadow_and_amplified_light() -> None:
    """Line integrals from far below zero to where the exponential underflows."""
    for attenuation in (-500.0, -3.0, 0.0, 40.0, 1400.0, 1e6):
        solids: list[Solid] = [Ellipsoid((0.3, 0.2, 0.25), attenuation), Cylinder(0.35, 0.3, attenuation)]
        at_once, steps = _both(_scene(Phantom.of(solids)), angle=0.3)
        np.testing.assert_array_equal(at_once, steps)


def test_the_steps_that_were_taken_are_told() -> None:
    steps: list[str] = []

    def on_step(step: str) -> AbstractContextManager[None]:
        steps.append(step)
        return nullcontext()

    expose(_scene(ALL), shots.shot(), on_step)
    assert steps == ["ideal"]
    steps.clear()
    expose(_scene(_Plain(ALL)), shots.shot(), on_step)
    assert steps == ["line_integrals", "beer_lambert", "digitise", "digitise"]


@dataclass(frozen=True)
class _Plain:
    """A sample with line integrals only."""

    phantom: Phantom
    radius: float = 1.0
    names: tuple[str, ...] = ()

    def line_integrals(self, angle: Any, detector: Detector) -> NDArray[np.float64]:
        return self.phantom.line_integrals(angle, detector)

    def attenuation(self, grid: Any, supersample: int = 3) -> NDArray[np.float32]:
        raise AssertionError("not asked for")

    def labels(self, grid: Any) -> NDArray[np.uint8]:
        raise AssertionError("not asked for")


def test_a_sample_need_not_count() -> None:
    plain = _Plain(ALL)
    assert isinstance(ALL, Counted)
    assert not isinstance(plain, Counted)
    np.testing.assert_array_equal(expose(_scene(plain), shots.shot()), expose(_scene(ALL), shots.shot()))


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
