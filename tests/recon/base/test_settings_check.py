"""Values that settings refuse, each kind with its sentence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from recon.base.settings_check import check_settings


@dataclass(frozen=True)
class Some:
    steps: int | None = None
    level: int = 3
    weight: float = 0.0
    rate: float | None = None
    start: str = "fbp"

    def __post_init__(self) -> None:
        check_settings(
            self, whole={"steps": 0, "level": (1, 16)}, least={"weight": 0.0}, above={"rate": 0.0},
            choices={"start": ("fbp", "tv")},
        )  # fmt: skip


@pytest.mark.parametrize(
    "values",
    [{}, {"steps": 0}, {"steps": np.int64(4)}, {"level": 16}, {"weight": 0}, {"rate": 1e-300}, {"start": "tv"}],
)
def test_what_is_within_the_bounds_is_taken(values: dict[str, Any]) -> None:
    Some(**values)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"steps": -1}, "steps must be a whole number of 0 or more, got -1"),
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
    ],
)
def test_others_are_refused_with_what_was_expected(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError) as refused:
        Some(**values)
    assert str(refused.value) == said
