"""Values in JSON that come back as they were: NaN and infinities, for which JSON has no number, are named."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

_NAMED = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


def named(values: object) -> Any:
    """The values as JSON can hold them, at any depth: NaN and infinities are text, the rest is as `plain` makes it."""
    return json.loads(json.dumps(values, default=plain, allow_nan=True), parse_constant=str)


def restored(values: Any) -> Any:
    """What `named` has made of values, with their NaN and infinities."""
    if isinstance(values, dict):
        return {name: restored(value) for name, value in values.items()}
    if isinstance(values, str):
        return _NAMED.get(values, values)
    return [restored(value) for value in values] if isinstance(values, list) else values


def plain(value: Any) -> Any:
    """What JSON has in place of a value without a type there: arrays are lists, mappings objects, the rest is text."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return dict(value) if isinstance(value, Mapping) else str(value)
