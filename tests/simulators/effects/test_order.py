"""Order: what cannot come before what, and that each such rule is about frames that would differ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from simulators.effects.catalogue import CATALOGUE
from simulators.effects.chain import Chain
from simulators.frame.mapping import SceneError
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene
from tests.simulators import shots
from tests.simulators.effects import on_demand
from tests.simulators.effects.parameters import PARAMETERS

RULES = [(earlier, later) for later, entry in CATALOGUE.items() for earlier in sorted(entry.follows)]
TELLING: Mapping[str, Mapping[str, Any]] = {
    "jump": {"view": 0, "turn_deg": 40.0, "shift_um": [100.0, 0.0, 0.0]},
    "backlash": {"lost_motion_deg": 20.0},
    "scatter": {"ratio": 0.3, "width_mm": 0.1, "background": 1000.0},
    "prnu": {"spread": 0.1},
    "dark_current": {"rate": 1000.0},
    "hot_pixels": {"fraction": 0.1},
    "zingers": {"rate": 1000.0},
    "dead_pixels": {"fraction": 0.1},
}
"""Parameters that make a difference seen in a small frame; the others as in parameters.py."""


def _scene(*names: str) -> Scene:
    entries = [{"kind": name, **TELLING.get(name, PARAMETERS[name])} for name in names]
    return replace(shots.scene(*entries, flux=4000.0), sample=on_demand.Cloud())


@pytest.mark.parametrize(("earlier", "later"), RULES)
def test_the_other_way_round_is_refused_with_the_reason(earlier: str, later: str) -> None:
    assert CATALOGUE[earlier].domain == CATALOGUE[later].domain
    _scene(earlier, later)
    with pytest.raises(SceneError, match=rf"scene.effects: effect '{earlier}' must come before '{later}': .*\w$"):
        _scene(later, earlier)


@pytest.mark.parametrize(("earlier", "later"), RULES)
def test_the_other_way_round_would_be_another_frame(earlier: str, later: str) -> None:
    allowed = _scene(earlier, later)
    forbidden = replace(allowed, chain=Chain(allowed.chain.effects[::-1]))
    one, other = (expose(scene, on_demand.shot(2)).astype(float) for scene in (allowed, forbidden))
    assert np.abs(one - other).max() > 5


@pytest.mark.parametrize("name", ["dark_current", "saturation", "dead_pixels"])
def test_the_readout_ends_the_electrons(name: str) -> None:
    with pytest.raises(SceneError, match=f"'{name}' must"):
        _scene("read_noise", name)


def test_what_only_weighs_the_light_may_stand_anywhere() -> None:
    """Their factors multiply."""
    one, other = _scene("prnu", "ring_current", "lost_beam"), _scene("lost_beam", "prnu", "ring_current")
    np.testing.assert_array_equal(expose(one, on_demand.shot(4)), expose(other, on_demand.shot(4)))
