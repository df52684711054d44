"""The chain of effects: how they act together, and in which order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, cast

import numpy as np
import pytest

from simulators.effects.catalogue import CATALOGUE, Domain
from simulators.effects.chain import AnomalyLabel, AnyEffect, Chain
from simulators.effects.exposure import MotionBlur
from simulators.frame.mapping import SceneError
from simulators.frame.shot import Image, Shot
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene
from tests.simulators import shots
from tests.simulators.effects import on_demand
from tests.simulators.effects.parameters import PARAMETERS


@dataclass(frozen=True)
class _Wanderer:
    """Two bodies that go opposite ways by as many pixels as the stage has turned tenths of a radian."""

    domain: Domain = Domain.OPTICAL_DEPTH

    name: ClassVar[str] = "wanderer"
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        return image

    def labels(self, shot: Shot) -> list[AnomalyLabel]:
        k = round(10 * shot.angle)
        return [
            AnomalyLabel("wanderer", (10 + k, 12 + k, 20 + k, 22 + k)),
            AnomalyLabel("wanderer", (30 - k, 33 - k, 40, 41), 1),
        ]


def _labels(domain: Domain, turned: float, **state: bool) -> tuple[AnomalyLabel, ...]:
    shot = shots.shot(angle=0.0, angle_at=lambda time: turned * (time - 1000.0) / 0.01, radius=0.5, **state)
    order: list[AnyEffect] = [MotionBlur(0.1, 10), cast(AnyEffect, _Wanderer(domain))]
    return Chain.of(order).labels(shot)


def test_what_turns_with_the_sample_is_labelled_wherever_it_is_while_the_frame_looks() -> None:
    # 10 moments of a turn by 2 rad: from 1 to 19 tenths.
    assert _labels(Domain.OPTICAL_DEPTH, 2.0) == (
        AnomalyLabel("wanderer", (11, 31, 21, 41)),
        AnomalyLabel("wanderer", (11, 32, 40, 41), 1),
    )
    assert _labels(Domain.OPTICAL_DEPTH, -2.0) == (
        AnomalyLabel("wanderer", (-9, 11, 1, 21)),
        AnomalyLabel("wanderer", (31, 52, 40, 41), 1),
    )


def test_what_acts_on_the_whole_exposure_is_asked_once() -> None:
    here = (AnomalyLabel("wanderer", (10, 12, 20, 22)), AnomalyLabel("wanderer", (30, 33, 40, 41), 1))
    assert _labels(Domain.PHOTONS, 2.0) == here
    assert _labels(Domain.OPTICAL_DEPTH, 2.0, sample=False) == here


def test_effects_that_are_no_anomalies_have_no_labels() -> None:
    assert Chain.of([MotionBlur()]).labels(shots.shot(angle_at=lambda time: 0.0)) == ()


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
