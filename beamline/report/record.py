"""The history of a fit as arrays, for its file and its figures, and the residual curve that measures its quality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.method import Progress

_FIELDS = {f.name: f.type for f in fields(Progress) if f.name not in ("unit", "least_steps")}  # figures
_WORDS = {"held_out": "views held out", "residual": "views used"}


def history_arrays(history: Sequence[Progress]) -> dict[str, NDArray[np.float64]]:
    """The history of a fit as equally long arrays, by name; empty without a history.

    A quantity that was never measured (all NaN) is left out.
    """
    if not history:
        return {}
    arrays = {name: np.array([getattr(p, name) for p in history], dtype=np.float64) for name in _FIELDS}
    return {name: values for name, values in arrays.items() if not np.isnan(values).all()}


def history_from(arrays: Mapping[str, NDArray[Any]]) -> tuple[Progress, ...]:
    """The history of a fit from `history_arrays`; quantities that were not recorded are NaN."""
    if not arrays:
        return ()
    n = len(arrays["seconds"])
    columns = []
    for name, kind in _FIELDS.items():
        values = np.asarray(arrays.get(name, np.full(n, np.nan))).tolist()
        columns.append([int(v) for v in values] if kind == "int" else values)
    return tuple(Progress(*values) for values in zip(*columns, strict=True))


@dataclass(frozen=True, eq=False)
class ResidualCurve:
    """The residual that measures the quality of a fit, against time.

    Attributes:
        views: the views of the residual: "views held out" or "views used".
        seconds, residuals: [measurement].
    """

    views: str
    seconds: NDArray[np.float64]
    residuals: NDArray[np.float64]


def residual_curve(arrays: Mapping[str, NDArray[np.floating]]) -> ResidualCurve | None:
    """The residual of the views held out, if there are any, else of the views used; None if neither was recorded."""
    name = next((name for name in _WORDS if name in arrays and np.isfinite(arrays[name]).any()), None)
    if name is None:
        return None
    seconds, residuals = np.asarray(arrays["seconds"], np.float64), np.asarray(arrays[name], np.float64)
    measured = np.isfinite(residuals)
    if name == "held_out":  # measured now and then; the history repeats the last value in between
        measured &= np.concatenate(([True], np.diff(residuals) != 0))
    return ResidualCurve(_WORDS[name], seconds[measured], residuals[measured])
