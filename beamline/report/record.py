"""The history of a fit as arrays, for its file and its figures, and the residual curve that measures its quality."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.assess.time_model import NextDecibel, duration_text, next_decibel, next_decibel_of_fit
from recon.base.method import Progress, Reconstruction
from recon.splatting.settings import FitSettings

_FIELDS = {f.name: f.type for f in fields(Progress) if f.name != "unit"}  # figures
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


def views_grew(made: Reconstruction) -> bool:
    """Whether the number of views grew during the fit."""
    return len({progress.n_views for progress in made.history}) > 1


def price_of_decibel(made: Reconstruction) -> NextDecibel | None:
    """The price of another dB: for a fit by fits of other lengths, for iterations by their own record.

    None for a direct method, while views still came, and for a resumed fit, whose whole time is not known. None
    also for other rates than those of the fits that were measured, as after following a scan.
    """
    judged, settings = residual_curve(history_arrays(made.history)), made.settings
    if judged is None or views_grew(made) or made.ending.resumed_from:
        return None
    if "pace" in settings:  # of a fit
        usual, steps = FitSettings(), made.history[-1].step
        slower = settings["pace"] < usual.pace and steps > usual.paced_for  # as in every longer fit
        if not (slower or settings["pace"] == usual.pace) or settings.get("decay", usual.decay) != usual.decay:
            return None
        return next_decibel_of_fit(made.history[-1].seconds, steps)
    return next_decibel(judged.seconds, judged.residuals)


def price_text(made: Reconstruction) -> str:
    """What a longer reconstruction would gain, as a sentence without its end; empty if it is not known."""
    if (price := price_of_decibel(made)) is None:
        return ""
    by_others = price.of == "volume"
    gain = "bring the volume 1 dB nearer to the sample" if by_others else "lower the misfit to the views by 1 dB"
    if not price.measurable:
        return f"A longer reconstruction would hardly {gain}"
    high = f"to {duration_text(price.high)}" if math.isfinite(price.high) else "or far more"
    source = ", as longer fits did on four other scans" if by_others else ""
    return f"About {duration_text(price.seconds)} more would {gain} ({duration_text(price.low)} {high}){source}"
