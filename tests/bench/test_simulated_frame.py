"""What a simulated frame costs; run with  pytest -m bench -s tests/bench/test_simulated_frame.py."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numba
import numpy as np
import pytest

from recon.base.volume import Grid
from simulators.effects.chain import Chain
from simulators.frame.detector import Detector
from simulators.frame.domain import Domain
from simulators.frame.pose import Pose
from simulators.frame.shot import Image, Shot
from simulators.light.beam import Beam
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid, Octahedron, Plate, Solid, TruncatedOctahedron, Tube
from simulators.samples.builders.battery import battery
from simulators.samples.sample import Sample
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene
from tests.simulators import shots

SIDE = 2048
DETECTOR = Detector.centred((SIDE, SIDE), 0.9 / SIDE)
REPEATS = 11


def _in_turns(*calls: Callable[[], object], repeats: int = REPEATS) -> list[tuple[float, float, float, float]]:
    """(lower quartile, median, upper quartile) and the processors' median in ms of each call, made in turns so that a
    noisy host troubles all alike."""
    times: list[list[tuple[float, float]]] = [[] for _ in calls]
    for _ in range(repeats + 1):
        for call, taken in zip(calls, times, strict=True):
            begin, worked = time.perf_counter(), time.process_time()
            call()
            taken.append(((time.perf_counter() - begin) * 1e3, (time.process_time() - worked) * 1e3))
    return [  # the first one compiles
        (*np.percentile([wall for wall, _ in taken[1:]], [25, 50, 75]), np.median([busy for _, busy in taken[1:]]))
        for taken in times
    ]


def _said(times: tuple[float, float, float, float]) -> str:
    return f"{times[1]:.1f} ms ({times[0]:.1f} to {times[2]:.1f}, cpu {times[3]:.1f})"


def _can() -> list[Solid]:
    return [Tube(0.4, 0.38, 0.8, 2.2), Cylinder(0.38, 0.8, 0.4)]


def _crystals(n: int, share: float) -> list[Solid]:
    """n crystals of all habits in a can, their shadows together `share` of the frame."""
    rng = np.random.default_rng(1)
    size = 0.9 * math.sqrt(share / (n * 2.5))
    solids = []
    for k in range(n):
        x, y = rng.uniform(-0.26, 0.26, 2).tolist()
        at, turn = (x, y, float(rng.uniform(-0.36, 0.36))), tuple(rng.normal(size=4).tolist())
        if k % 4 == 0:
            solids.append(Ellipsoid((size, 0.9 * size, 0.8 * size), 4.0, at, turn))
        elif k % 4 == 1:
            solids.append(Octahedron((1.3 * size, 1.2 * size, 1.3 * size), 4.0, at, turn))
        elif k % 4 == 2:
            solids.append(TruncatedOctahedron((1.3 * size, 1.2 * size, 1.3 * size), 4.0, centre=at, quaternion=turn))
        else:
            solids.append(Plate(2.2 * size, 0.8 * size, 4.0, at, turn))
    return solids


SAMPLES: dict[str, Callable[[], list[Solid]]] = {
    "can": _can,
    "battery, 150 particles": lambda: list(battery(np.random.default_rng(7), (0.9, 0.9), 150)),
    "battery, 1000 particles": lambda: list(battery(np.random.default_rng(7), (0.9, 0.9), 1000)),
    "1000 crystals, 2 deep": lambda: _can() + _crystals(1000, 2.0),
}


@dataclass(frozen=True)
class _Nothing:
    """An effect without one: the frame is made step by step."""

    name: ClassVar[str] = "nothing"
    domain: ClassVar[Domain] = Domain.COUNTS
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        return image


@pytest.mark.bench
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", SAMPLES)
def test_an_ideal_frame_costs_no_more_than_half_as_much_again_as_its_exponential(
    name: str, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
    sample: Sample = Phantom.of(SAMPLES[name]())
    scene, shot = Scene(sample=sample, beam=Beam(1e5), chain=Chain.of([])), shots.shot(detector=DETECTOR, exposure=0.05)
    stepwise = replace(scene, chain=Chain.of([_Nothing()]))
    depth = sample.line_integrals(shot.angle, DETECTOR)
    ideal, negative, bare, lines, steps = _in_turns(
        lambda: expose(scene, shot),
        lambda: np.exp(-depth),
        lambda: np.exp(depth),
        lambda: sample.line_integrals(shot.angle, DETECTOR),
        lambda: expose(stepwise, shot),
    )
    print(
        f"\n{name}, {SIDE}², {threads} threads, {(depth > 0).mean():.0%} in shadow: ideal {_said(ideal)}; "
        f"np.exp(-depth) {_said(negative)}, ratio {ideal[1] / negative[1]:.2f}; np.exp alone {_said(bare)}, ratio "
        f"{ideal[1] / bare[1]:.2f} (cpu {ideal[3] / bare[3]:.2f}); line integrals {_said(lines)}; "
        f"step by step {_said(steps)}"
    )
    if "crystals" not in name and "1000" not in name:
        assert ideal[1] < 1.5 * negative[1]


def _balls(n: int) -> Phantom:
    """n balls whose shadows together are 10 % of the frame."""
    radius = 0.9 * math.sqrt(0.1 / (n * math.pi))
    centres = np.random.default_rng(2).uniform(radius - 0.45, 0.45 - radius, (n, 3)).tolist()
    return Phantom.of([Ellipsoid((radius, radius, radius), 1.0, (x, y, z)) for x, y, z in centres])


@pytest.mark.bench
def test_time_grows_with_what_is_covered_not_with_solids_times_pixels() -> None:
    """A thousand times as many balls in the same area may not cost twenty times as much (what each row of each costs
    grows with the root of their number)."""
    numbers = (10, 100, 1000, 10_000)
    scenes = [Scene(sample=_balls(n), beam=Beam(1e5), chain=Chain.of([])) for n in numbers]
    shot = shots.shot(detector=DETECTOR, exposure=0.05)
    times = _in_turns(*[partial(expose, scene, shot) for scene in scenes], repeats=9)
    print("\nideal: " + ", ".join(f"{n} balls {_said(t)}" for n, t in zip(numbers, times, strict=True)))
    assert times[-1][1] < 20 * times[0][1]


@pytest.mark.bench
def test_other_beams_and_poses() -> None:
    phantom = Phantom.of(SAMPLES["battery, 150 particles"]())
    turned = Pose.turned(0.4, SIDE)
    cone = Detector.centred((SIDE, SIDE), 0.9 / SIDE, sod=20.0)
    rolling = turned.turned_by(np.linspace(0, 0.01, SIDE))
    times = _in_turns(
        lambda: phantom.line_integrals(turned, DETECTOR),
        lambda: phantom.line_integrals(turned.shifted_by((0.01, 0, 0.02)), DETECTOR),
        lambda: phantom.line_integrals(rolling, DETECTOR),
        lambda: phantom.line_integrals(turned.tilted_by((0.01, 0.02)), DETECTOR),
        lambda: phantom.line_integrals(turned, cone),
        repeats=9,
    )
    names = ("turned", "shifted", "a pose a row", "tilted", "cone")
    print("\nline integrals: " + ", ".join(f"{name} {_said(t)}" for name, t in zip(names, times, strict=True)))


@pytest.mark.bench
def test_truth_and_labels() -> None:
    grid = Grid((256, 256, 256), 0.9 / 256)
    phantom = Phantom.of(battery(np.random.default_rng(7), (0.9, 0.9), 500))
    labels, truth = _in_turns(lambda: phantom.labels(grid), lambda: phantom.attenuation(grid), repeats=3)
    print(f"\n256³, 502 solids: labels {_said(labels)}, truth {_said(truth)}")
    assert labels[1] < 3000
