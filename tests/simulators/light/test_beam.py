"""Beam: what a scene may say of its light, and what contradicts itself."""

from __future__ import annotations

import math

from simulators.frame.mapping import build
from simulators.light import Beam
from tests.refused_calls import refused_calls


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


test_calls_that_are_refused = refused_calls(__file__, globals())
