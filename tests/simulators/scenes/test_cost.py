"""Explain: every step of a frame is listed in order, what is not named is not, and the costs are those of the steps."""

from __future__ import annotations

from typing import Any

import pytest

from simulators.effects.catalogue import CATALOGUE, Domain
from simulators.scenes.cost import explain
from simulators.scenes.scene import load_scene
from tests.clock import SteppedClock
from tests.simulators.shots import PHANTOM, shot

EFFECTS = ["rolling_shutter", {"kind": "beam_profile", "sigma": [1.0, 1.0]}, "photon_noise", "read_noise", "offset"]


def _scene(*effects: Any) -> Any:
    return load_scene({"phantom": PHANTOM, "beam": {"photons_per_s": 1e5}, "effects": list(effects)})


def test_steps_stand_in_the_order_in_which_they_run() -> None:
    found = explain(_scene(*EFFECTS), shot(angle_at=lambda time: 0.4), SteppedClock(tick=1e-3), repeats=2)
    named = [cost.name for cost in found.costs]
    assert named == [
        "line_integrals", "rolling_shutter", "beer_lambert", "beam_profile", "photon_noise", "read_noise", "offset",
        "digitise",
    ]  # fmt: skip
    domains = [cost.domain for cost in found.costs]
    assert domains[1] is Domain.MOTION
    assert domains[0] is domains[2] is domains[-1] is None
    assert all(cost.summary for cost in found.costs)


def test_costs_are_those_of_the_steps() -> None:
    found = explain(_scene(*EFFECTS), shot(angle_at=lambda time: 0.4), SteppedClock(tick=1e-3), repeats=3)
    # Each step is entered once, but for "digitise", which converts before the counts' effects and rounds after them.
    ms = {cost.name: cost.ms for cost in found.costs}
    assert ms == {
        name: pytest.approx(2 if name == "digitise" else 0 if name == "rolling_shutter" else 1) for name in ms
    }
    assert found.ms == pytest.approx(1)
    size = {cost.name: cost.size for cost in found.costs}
    image = 60 * 80 * 8
    assert image <= size["line_integrals"] < 4 * image
    assert size["offset"] < image


def test_what_is_unused_is_said() -> None:
    found = explain(_scene("offset"), shot(), SteppedClock(tick=1e-3), repeats=1)
    assert {name for name, _ in found.unused} == set(CATALOGUE) - {"offset"}
    assert dict(found.unused)["photon_noise"] == CATALOGUE["photon_noise"].summary
    bare = explain(_scene(), shot(), SteppedClock(tick=1e-3), repeats=1)
    assert [cost.name for cost in bare.costs] == ["line_integrals", "beer_lambert", "digitise"]
