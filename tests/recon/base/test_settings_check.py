"""Values that settings refuse, each kind with its sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import pytest

from recon.base.declared_types import Bound, Checked, Count, Natural, NonNegative, Positive
from recon.base.kernel import Kernel
from recon.base.volume import Grid


@dataclass(frozen=True)
class Some(Checked):
    steps: Natural | None = None
    level: Annotated[int, Bound(1, 16)] = 3
    weight: NonNegative = 0.0
    rate: Positive | None = None
    start: Literal["fbp", "tv"] = "fbp"
    shape: Kernel = Kernel.COMPACT
    size: tuple[int, int] | None = None
    names: Sequence[str] = ()
    part: Grid | Count = 1


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"steps": 0},
        {"steps": np.int64(4)},
        {"level": 16},
        {"weight": 0},
        {"rate": 1e-300},
        {"start": "tv"},
        {"shape": "gaussian"},
        {"size": [1, 2]},
        {"names": ["a"]},
        {"part": Grid((1, 1, 1))},
    ],
)
def test_what_is_within_the_bounds_is_taken(values: dict[str, Any]) -> None:
    Some(**values)


def test_a_number_in_an_array_without_axes_is_the_number() -> None:
    some = Some(steps=np.array(4), weight=np.array(0.5))
    assert (type(some.steps), type(some.weight)) == (int, float)
    assert some == Some(4, weight=0.5)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"steps": -1}, "steps must be a whole number of 0 or more, got -1"),
        ({"steps": np.array(-1)}, "steps must be a whole number of 0 or more, got -1"),
        ({"steps": 1.5}, "steps must be a whole number of 0 or more, got 1.5"),
        ({"steps": True}, "steps must be a whole number of 0 or more, got True"),
        ({"level": None}, "level must be a whole number from 1 to 16, got None"),
        ({"level": 17}, "level must be a whole number from 1 to 16, got 17"),
        ({"weight": -1e-9}, "weight must be finite and 0 or more, got -1e-09"),
        ({"weight": math.nan}, "weight must be finite and 0 or more, got nan"),
        ({"weight": "0"}, "weight must be finite and 0 or more, got '0'"),
        ({"rate": 0.0}, "rate must be finite and above 0, got 0.0"),
        ({"rate": math.inf}, "rate must be finite and above 0, got inf"),
        ({"start": "tvs"}, "start 'tvs' is unknown; legal: fbp, tv (did you mean tv?)"),
        ({"start": None}, "start None is unknown; legal: fbp, tv"),
        ({"shape": "round"}, "shape 'round' is unknown; legal: gaussian, compact:1.5"),
        ({"size": (1, 2, 3)}, "size must be 2 whole numbers or None, got (1, 2, 3)"),
        ({"size": 3}, "size must be 2 whole numbers or None, got 3"),
        ({"names": "ab"}, "names must be a list or tuple of texts, got 'ab'"),
        ({"part": 0}, "part must be a whole number of 1 or more, got 0"),
        ({"part": Grid}, "part must be a Grid or a whole number, got the class Grid; give an object, such as Grid()"),
        ({"part": "x" * 200}, f"part must be a Grid or a whole number, got '{'x' * 76}..."),
    ],
)
def test_others_are_refused_with_what_was_expected(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError) as refused:
        Some(**values)
    assert str(refused.value) == said
