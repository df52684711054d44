"""Values come back from JSON as they were, and the JSON is one for every reader."""

from __future__ import annotations

import json
import math
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.base.json_values import named, restored
from recon.base.kernel import Kernel

_NAMES = ("NaN", "Infinity", "-Infinity")
_PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text().filter(lambda text: text not in _NAMES)
_VALUES = st.recursive(
    _PLAIN, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3), max_leaves=12
)


def back(values: Any) -> Any:
    """Through text that only has what JSON has."""
    return restored(json.loads(json.dumps(named(values), allow_nan=False)))


@given(_VALUES)
def test_values_come_back_to_the_bit_at_any_depth(values: Any) -> None:
    assert repr(back(values)) == repr(values)  # which tells -0.0 from 0.0, and NaN from all else


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_what_json_has_no_type_for_becomes_what_it_has(value: float) -> None:
    single = np.float32(value)
    given = {
        "a": {"b": (1, single)},
        "c": np.array([[1.5, value]]),
        "d": MappingProxyType({"e": value}),
        3: Kernel.COMPACT,
    }
    assert repr(back(given)) == repr(
        {"a": {"b": [1, value]}, "c": [[1.5, value]], "d": {"e": value}, "3": str(Kernel.COMPACT)}
    )
    assert named(given)["a"]["b"][1] in _NAMES
    assert back([np.int64(3), np.bool_(True), np.zeros((0, 2))]) == [3, True, []]
