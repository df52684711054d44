"""The history of a fit as arrays, with its residual curve and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from beamline.report.figures import WIDTH, finish, new_figure, png
from recon.base.method import Progress, Reconstruction

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FIELDS = {f.name: f.type for f in fields(Progress) if f.name != "unit"}  # figures
_WORDS = {"held_out": "held-out projections", "residual": "projections used"}


def history_arrays(history: Sequence[Progress]) -> dict[str, NDArray[np.float64]]:
    """The history of a fit as arrays of equal length, by name; empty if there is no history.

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
    columns = [
        [int(v) if kind == "int" else v for v in np.asarray(arrays.get(name, np.full(n, np.nan))).tolist()]
        for name, kind in _FIELDS.items()
    ]
    return tuple(Progress(*values) for values in zip(*columns, strict=True))


@dataclass(frozen=True, eq=False)
class ResidualCurve:
    """The residual that measures the quality of a fit, against time.

    Attributes:
        views: the projections of the residual: "held-out projections" or "projections used".
        seconds, residuals: [measurement].
    """

    views: str
    seconds: NDArray[np.float64]
    residuals: NDArray[np.float64]

    @property
    def decibels(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Time in s and -20 log10 of the residual, for the measurements above 0."""
        known = (self.seconds > 0) & (self.residuals > 0)
        return self.seconds[known], -20 * np.log10(self.residuals[known])


def residual_curve(arrays: Mapping[str, NDArray[np.floating]]) -> ResidualCurve | None:
    """The residual of the held-out projections, if there are any, otherwise of the projections used; None if neither
    was recorded."""
    name = next((name for name in _WORDS if name in arrays and np.isfinite(arrays[name]).any()), None)
    if name is None:
        return None
    seconds, residuals = np.asarray(arrays["seconds"], np.float64), np.asarray(arrays[name], np.float64)
    measured = np.isfinite(residuals)
    if name == "held_out":  # measured only sometimes; in between, the history repeats the last value
        measured &= np.concatenate(([True], np.diff(residuals) != 0))
    return ResidualCurve(_WORDS[name], seconds[measured], residuals[measured])


def views_grew(result: Reconstruction) -> bool:
    """True if the number of projections grew during the fit."""
    return len({progress.n_views for progress in result.history}) > 1


def quality_against_time(
    history: Mapping[str, NDArray[np.floating]],
) -> bytes:
    """Curves of a fit against time: loss and residuals, the residual in dB, and the numbers of projections and
    Gaussians.

    Args:
        history: arrays of equal length: "seconds", "loss", and, if known, "residual", "held_out", "n_views",
            "n_gaussians".
    """
    seconds = history["seconds"]
    growing = [
        (name, label)
        for name, label in (("n_views", "views"), ("n_gaussians", "Gaussians"))
        if name in history and np.ptp(history[name]) > 0
    ]
    curve = residual_curve(history)
    figure = new_figure((WIDTH, 3.1))
    misfit_axes, *others = np.ravel(figure.subplots(1, 1 + (curve is not None) + bool(growing)))
    _misfit(misfit_axes, history)
    if curve is not None:
        axes = others.pop(0)
        axes.plot(*curve.decibels, color="tab:green", lw=1.2, marker=".", ms=3)
        finish(axes, "time (s)", "dB below the data", f"Residual, {curve.views}", grid=True)
    if growing:
        axes = others.pop(0)
        for (name, label), colour in zip(growing, ("tab:purple", "0.4"), strict=False):
            values = history[name] / np.max(history[name])
            axes.step(seconds, values, where="post", color=colour, lw=1.2, label=f"{label} / {history[name].max():.0f}")
        axes.set_ylim(0, 1.05)
        finish(axes, "time (s)", "fraction of the largest value", "Growth", grid=True)
    return png(figure)


def _misfit(axes: Axes, history: Mapping[str, NDArray[np.floating]]) -> None:
    """Loss and residuals. The axis is logarithmic if they fall to less than a tenth."""
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    for name, label, colour in (
        ("loss", "loss", "tab:blue"),
        ("residual", "residual", "tab:orange"),
        ("held_out", "residual, held out", "tab:red"),
    ):
        if name == "loss" and np.array_equal(history[name], history.get("residual", [])):
            continue  # the loss of iterations is the residual itself
        if name in history and np.any(np.isfinite(history[name])):
            axes.plot(history["seconds"], history[name], color=colour, lw=1.2, marker=".", ms=3, label=label)
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=np.float64) for line in axes.get_lines()])
    if values.min(initial=np.inf) > 0 and values.max() > 10 * values.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
        axes.yaxis.set_major_formatter(ScalarFormatter())
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(bottom=0)
    finish(axes, "time (s)", "", "Misfit", grid=True)
