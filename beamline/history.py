"""A fit's own record as arrays: kept in its file, shown in its figure, and read for the price of another decibel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.fit import Progress

_FIELDS = {f.name: f.type for f in fields(Progress)}
_WORDS = {"held_out": "views held out", "residual": "views used"}


def history_arrays(history: Sequence[Progress]) -> dict[str, NDArray[np.float64]]:
    """The history of a fit as equally long arrays, by name; empty where there is none.

    What was never measured (all NaN) is left out.
    """
    if not history:
        return {}
    arrays = {name: np.array([getattr(p, name) for p in history], dtype=np.float64) for name in _FIELDS}
    return {name: values for name, values in arrays.items() if not np.isnan(values).all()}


def history_of(arrays: Mapping[str, NDArray[Any]]) -> tuple[Progress, ...]:
    """The history of a fit from `history_arrays`; what was not recorded is NaN."""
    if not arrays:
        return ()
    n = len(arrays["seconds"])
    columns = []
    for name, kind in _FIELDS.items():
        values = np.asarray(arrays.get(name, np.full(n, np.nan))).tolist()
        columns.append([int(v) for v in values] if kind == "int" else values)
    return tuple(Progress(*values) for values in zip(*columns, strict=True))


def judged_by(arrays: Mapping[str, NDArray[np.floating]]) -> str | None:
    """The name of the residual that tells how good a fit is: of views held out where there are any, else of those used.

    None where neither was recorded.
    """
    return next((name for name in _WORDS if name in arrays and np.isfinite(arrays[name]).any()), None)


def judged_views(name: str) -> str:
    """Which views a residual is of, in words."""
    return _WORDS[name]
