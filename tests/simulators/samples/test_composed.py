"""Solids: grey ones have the name that they are given, and what is wrong is refused at its place."""

from __future__ import annotations

from typing import Any

import pytest

from simulators.frame.mapping import SceneError
from simulators.frame.shot import Detector
from simulators.samples.sample import Sample
from simulators.scenes.scene import load_scene

WALL = {"kind": "box", "edges": [0.1, 0.02, 0.1], "attenuation": 2.0, "name": "wall"}


def _sample(*solids: Any) -> Sample:
    return load_scene({"phantom": {"kind": "solids", "solids": list(solids)}, "beam": {"photons_per_s": 1.0}}).sample


def test_a_solid_is_called_as_the_scene_says_or_by_its_kind() -> None:
    sample = _sample(WALL, {key: value for key, value in WALL.items() if key != "name"})
    assert sample.names == ("wall", "box")
    assert sample.line_integrals(0.0, Detector.centred((1, 1), 0.01))[0, 0] == pytest.approx(2 * 0.02 * 2.0)


@pytest.mark.parametrize(
    ("solid", "words"),
    [
        ("box", r"solids\[1\] \(box\): key 'edges' is missing"),
        (WALL | {"colour": 1}, r"solids\[1\] \(box\): key 'colour' is unknown"),
        (WALL | {"name": 5}, r"solids\[1\]: name must be text, got {'name': 5}"),
    ],
)
def test_a_wrong_solid_is_refused(solid: Any, words: str) -> None:
    with pytest.raises(SceneError, match=words):
        _sample(WALL, solid)
