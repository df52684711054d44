"""A fit's own record as arrays: kept in its file, shown in its figure, and read for the price of another decibel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.method import Progress

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


@dataclass(frozen=True, eq=False)
class Judged:
    """The residual that tells how good a fit is, each time that it was looked at.

    Attributes:
        views: which views it is of, in words.
        seconds, residuals: [look].
    """

    views: str
    seconds: NDArray[np.float64]
    residuals: NDArray[np.float64]


def judged_by(arrays: Mapping[str, NDArray[np.floating]]) -> Judged | None:
    """The residual of views held out where there are any, else of those used; None where neither was recorded."""
    name = next((name for name in _WORDS if name in arrays and np.isfinite(arrays[name]).any()), None)
    if name is None:
        return None
    seconds, residuals = np.asarray(arrays["seconds"], np.float64), np.asarray(arrays[name], np.float64)
    looks = np.isfinite(residuals)
    if name == "held_out":  # looked at now and then, and said again in between
        looks &= np.concatenate(([True], np.diff(residuals) != 0))
    return Judged(_WORDS[name], seconds[looks], residuals[looks])
