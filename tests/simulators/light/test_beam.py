"""Beam: what a scene may say of its light, and what contradicts itself."""

from __future__ import annotations

import math
from typing import Any

import pytest

from simulators.frame.mapping import SceneError, build
from simulators.light import Beam


def test_a_scene_can_say_every_light() -> None:
    mapping = {"photons_per_s": 1e5, "energy_kev": 8.3485, "bandwidth": 1e-4, "harmonics": {3: 0.01}}
    beam = build(Beam, "beam", mapping)
    assert (beam.energy_kev, beam.bandwidth, dict(beam.harmonics or {})) == (8.3485, 1e-4, {3: 0.01})
    assert build(Beam, "beam", mapping | {"harmonics": {"3": 0.01}}) == beam  # keys of JSON are text
    table = build(Beam, "beam", {"photons_per_s": 1, "spectrum": [[20, 1], [30, 2]]})
    assert table.spectrum == ((20.0, 1.0), (30.0, 2.0))
    tube = build(Beam, "beam", {"photons_per_s": 1, "tube": {"kv": 60, "filters": {"Al": 1.0}}}).tube
    assert tube is not None and (tube.kv, dict(tube.filters or {})) == (60.0, {"Al": 1.0})
    assert [build(Beam, "beam", {"photons_per_s": 1} | more).has_energy for more in ({}, {"energy_kev": 8})] == [
        False, True,
    ]  # fmt: skip


def test_the_source_is_far_unless_it_is_said() -> None:
    assert Beam(1.0).source_distance == math.inf
    assert Beam(1.0, 20.0, 100.0).source_distance == 20.0


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"photons_per_s": -1}, "photons_per_s is -1; expected a number >= 0"),
        ({"sod": 5}, "a cone needs both sod and sdd"),
        ({"sod": 5, "sdd": 4}, "got 5.0 and 4.0 mm"),
        (
            {"sod": 1e200, "sdd": 1e201},
            r"must lie in 1e-06 \.\.\. 1e\+09 mm, got 1e\+200 and 1e\+201; a beam from farther",
        ),
        ({"sod": 1e-300, "sdd": 1.0}, "must lie in"),
        ({"energy_kev": 8, "tube": {"kv": 60}}, "energy_kev and tube exclude each other"),
        ({"bandwidth": 0.01}, "bandwidth needs an energy_kev, which is missing"),
        ({"harmonics": {3: 0.1}, "spectrum": [[8, 1]]}, "harmonics needs an energy_kev"),
        ({"energy_kev": 8, "harmonics": {2: 0.5, 3: 0.5}}, "below 1 in sum"),
        ({"energy_kev": 8, "harmonics": [3, 0.1]}, r"beam.harmonics is \[3, 0.1\]; expected a group of keys: any"),
        (
            {"energy_kev": 8, "harmonics": {"third": 0.1}},
            "beam.harmonics.third: key must be a valid integer",
        ),
        ({"spectrum": []}, "not all of weight 0"),
        ({"spectrum": [[20]]}, r"beam.spectrum.0 is \[20\]; expected a list of 2"),
        ({"tube": {"volts": 60}}, "beam.tube.volts is not a known key; legal keys there: kv, filters"),
    ],
)
def test_a_light_that_cannot_be_is_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        build(Beam, "beam", {"photons_per_s": 1.0} | wrong)
