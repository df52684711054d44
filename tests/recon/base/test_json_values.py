"""Values without a JSON type are converted, and numbers of Python's JSON are read back unchanged."""

from __future__ import annotations

import json
import math
from types import MappingProxyType

import numpy as np
import pytest

from recon.base.json_values import plain
from recon.base.kernel import Kernel


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_what_json_has_no_type_for_becomes_what_it_has(value: float) -> None:
    given = {
        "a": {"b": (1, np.float32(value))},
        "c": np.array([[1.5, value]]),
        "d": MappingProxyType({"e": value}),
        "f": "NaN",
        3: Kernel.COMPACT,
    }
    assert repr(json.loads(json.dumps(given, default=plain, allow_nan=True))) == repr(
        {"a": {"b": [1, value]}, "c": [[1.5, value]], "d": {"e": value}, "f": "NaN", "3": str(Kernel.COMPACT)}
    )
    back = json.loads(json.dumps([np.int64(3), np.bool_(True), np.zeros((0, 2))], default=plain))
    assert back == [3, True, []]
