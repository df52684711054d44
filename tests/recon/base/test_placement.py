"""Placement of views: what is left out, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from recon.base.geometry import Geometry


def test_an_axis_is_never_taken_for_a_pitch() -> None:
    """What a user may leave out has a name: a third number was the pitch, and meant as the axis."""
    given: Any = ([0.0], (4, 96), 47.5)
    with pytest.raises(TypeError, match="positional"):
        Geometry.parallel(*given)
    for cone in ((*given, 50.0, 70.0, 47.5), ([0.0], 96, 0.5, 50.0, 70.0, 47.5)):
        with pytest.raises(TypeError, match="positional"):
            (Geometry.cone if cone[1] == (4, 96) else Geometry.fan)(*cone)


def test_the_axis_is_in_the_middle_unless_told() -> None:
    assert Geometry.parallel([0.0], (4, 10)).axis_col == 4.5
    assert Geometry.parallel([0.0], (4, 10), axis_col=3.2).axis_col == 3.2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"angles": []}, "non-empty"),
        ({"angles": [0.0, np.nan]}, "not finite"),
        ({"detector_shape": (0, 4)}, "detector_shape"),
        ({"pixel_pitch": -1.0}, "pixel_pitch"),
        ({"axis_col": np.inf}, "axis_col"),
    ],
)
def test_impossible_geometries_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Geometry.parallel(**({"angles": [0.0], "detector_shape": (4, 4)} | arguments))  # type: ignore[arg-type]
