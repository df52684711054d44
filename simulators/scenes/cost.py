"""Explain: the steps of one frame of a scene in order, with their cost, and the effects that are not computed.

Each step is timed where it runs. Effects that change the rays of a frame, such as motion, repeat the other steps.
The cost of such an effect is the time of a frame with it, minus the time of a frame without it.
"""

from __future__ import annotations

import statistics
import tracemalloc
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

from simulators.effects.catalogue import CATALOGUE, Domain
from simulators.effects.chain import Chain, ImageEffect
from simulators.frame.shot import Shot
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene

Seconds = Callable[[], float]

STEPS = {
    "line_integrals": "rays through the sample",
    "beer_lambert": "photons x exp(-depth)",
    "digitise": "electrons to whole counts",
}
"""Steps of every frame, independent of effects."""


@dataclass(frozen=True)
class Cost:
    """Cost of a step of a frame.

    Attributes:
        name: of the step or effect.
        domain: what it acts on; None for the steps of every frame.
        ms: median.
        size: peak memory in bytes while it ran.
        summary: what happens.
    """

    name: str
    domain: Domain | None
    ms: float
    size: int
    summary: str


@dataclass(frozen=True)
class FrameCost:
    """Cost of a frame of a scene.

    Attributes:
        costs: in the order in which the steps run.
        ms: median of a whole frame.
        unused: (name, summary) of the catalogue's effects that the scene does not name.
    """

    costs: tuple[Cost, ...]
    ms: float
    unused: tuple[tuple[str, str], ...]


def explain(scene: Scene, shot: Shot, now: Seconds, repeats: int = 5) -> FrameCost:
    """Compute the frame `repeats` times in each variant, after one round that is not counted (it compiles).

    Args:
        now: s, of a clock for short times.
    """
    # An effect that changes the rays is not a step: its cost is the additional time of a whole frame.
    ray_effects = [effect for effect in scene.chain.effects if not isinstance(effect, ImageEffect)]
    rest = [effect for effect in scene.chain.effects if isinstance(effect, ImageEffect)]
    variants = [replace(scene, chain=Chain.of([*ray_effects[:n], *rest])) for n in range(len(ray_effects) + 1)]
    rounds = [_round(variants, shot, now) for _ in range(repeats + 1)][1:]
    seconds = {name: statistics.median(steps[name] for steps, _ in rounds) for name in rounds[0][0]}
    sizes, peaks = _sizes(variants[0], shot), [_peak(each, shot) for each in variants]
    costs = [_cost("line_integrals", seconds["line_integrals"], sizes["line_integrals"])]
    for n, effect in enumerate(ray_effects):
        more = statistics.median(whole[n + 1] - whole[n] for _, whole in rounds)
        costs.append(_cost(effect.name, more, max(peaks[n + 1] - peaks[n], 0)))
    order = [effect.name for effect in rest]
    depth = [effect.name for effect in rest if effect.domain is Domain.OPTICAL_DEPTH]
    for name in [*depth, "beer_lambert", *order[len(depth) :], "digitise"]:
        if name in seconds:
            costs.append(_cost(name, seconds[name], sizes[name]))
    named = {effect.name for effect in scene.chain.effects}
    left = tuple((name, entry.summary) for name, entry in CATALOGUE.items() if name not in named)
    return FrameCost(tuple(costs), statistics.median(whole[-1] for _, whole in rounds) * 1e3, left)


def _cost(name: str, seconds: float, size: int) -> Cost:
    if name in STEPS:
        return Cost(name, None, seconds * 1e3, size, STEPS[name])
    return Cost(name, CATALOGUE[name].domain, seconds * 1e3, size, CATALOGUE[name].summary)


def _round(scenes: Sequence[Scene], shot: Shot, now: Seconds) -> tuple[Mapping[str, float], Sequence[float]]:
    """Seconds of the first scene's steps by name, and of a whole frame of each scene.

    All are timed in turns, so that a change of the machine's speed affects all of them."""
    steps: dict[str, float] = defaultdict(float)

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        start = now()
        yield
        steps[name] += now() - start

    expose(scenes[0], shot, timed)
    whole = []
    for scene in scenes:
        start = now()
        expose(scene, shot)
        whole.append(now() - start)
    return steps, whole


def _sizes(scene: Scene, shot: Shot) -> dict[str, int]:
    """Peak memory of each step of a frame in bytes."""
    sizes: dict[str, int] = defaultdict(int)

    @contextmanager
    def weighed(name: str) -> Iterator[None]:
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        yield
        sizes[name] = max(sizes[name], tracemalloc.get_traced_memory()[1] - before)

    with _traced():
        expose(scene, shot, weighed)
    return sizes


def _peak(scene: Scene, shot: Shot) -> int:
    with _traced():
        expose(scene, shot)
        return tracemalloc.get_traced_memory()[1]


@contextmanager
def _traced() -> Iterator[None]:
    """Memory is traced within; afterwards the tracer is in its previous state."""
    if tracemalloc.is_tracing():
        tracemalloc.reset_peak()
        yield
        return
    tracemalloc.start()
    try:
        yield
    finally:
        tracemalloc.stop()
