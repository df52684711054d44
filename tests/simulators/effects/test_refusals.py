"""Wrong parameters of effects: a scene that has one is refused, with the path, the rule and the value."""

from __future__ import annotations

from typing import Any

from simulators.effects.catalogue import load_effect
from simulators.frame.mapping import build
from tests.refused_calls import refused_calls

ALWAYS: dict[str, dict[str, Any]] = {
    "floaters": {"distance": [0.7, 0.9]},
    "ghost": {"view": 4, "width": 0.2, "speed": 0.3},
    "phase_fringes": {"delta_beta": 100.0, "distance": 50.0, "energy": 20.0},
}
"""What an effect cannot do without."""


def effect(name: str, **parameters: Any) -> object:
    return build(load_effect(name), name, ALWAYS.get(name, {}) | parameters)


test_calls_that_are_refused = refused_calls(__file__, globals())
