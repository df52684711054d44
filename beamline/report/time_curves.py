"""Pictures of a fit against time: misfit, quality, growth, and what another dB would cost."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter
from numpy.typing import NDArray

from beamline.report.figures import WIDTH, new_figure, png
from beamline.report.record import residual_curve
from recon.assess.time_model import NextDecibel, duration_text, record


def quality_against_time(
    history: Mapping[str, NDArray[np.floating]],
    psnr: Sequence[tuple[float, float]] = (),
    further: NextDecibel | None = None,
) -> bytes:
    """A fit against time: loss and residuals, the residual as dB, PSNR of snapshots, number of views and Gaussians.

    Args:
        history: equally long "seconds", "loss", and where known "residual", "held_out", "n_views", "n_gaussians".
        psnr: (seconds, dB) of each snapshot; none without a truth.
        further: time that another dB would take; None if it is not known.
    """
    seconds = history["seconds"]
    growing = [
        (name, label)
        for name, label in (("n_views", "views"), ("n_gaussians", "Gaussians"))
        if name in history and np.ptp(history[name]) > 0
    ]
    curve = residual_curve(history)
    panels = 1 + (curve is not None) + bool(psnr) + bool(growing)
    down, across = (1, panels) if panels < 4 else (2, 2)
    figure = new_figure((WIDTH, 3.1 * down))
    left, *others = np.ravel(figure.subplots(down, across))
    for name, label, colour in (
        ("loss", "loss", "tab:blue"),
        ("residual", "residual", "tab:orange"),
        ("held_out", "residual, held out", "tab:red"),
    ):
        if name == "loss" and np.array_equal(history[name], history.get("residual", [])):
            continue  # the loss of iterations is the residual itself
        if name in history and np.any(np.isfinite(history[name])):
            left.plot(seconds, history[name], color=colour, lw=1.2, marker=".", ms=3, label=label)
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=np.float64) for line in left.get_lines()])
    if values.min(initial=np.inf) > 0 and values.max() > 10 * values.min():
        left.set_yscale("log")
        left.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
        left.yaxis.set_major_formatter(ScalarFormatter())
        left.yaxis.set_minor_formatter(NullFormatter())
    else:
        left.set_ylim(bottom=0)
    left.set(xlabel="time (s)", title="Misfit")
    left.legend(fontsize=8)
    if curve is not None:
        _decibels(others.pop(0), *record(curve.seconds, curve.residuals), curve.views, further)
    if psnr:
        axes = others.pop(0)
        axes.plot(*np.array(psnr).T, color="tab:green", lw=1.2, marker="o", ms=3)
        axes.set(xlabel="time (s)", ylabel="PSNR (dB)", title="Quality against the truth")
    if growing:
        axes = others.pop(0)
        for (name, label), colour in zip(growing, ("tab:purple", "0.4"), strict=False):
            values = history[name] / np.max(history[name])
            axes.step(seconds, values, where="post", color=colour, lw=1.2, label=f"{label} / {history[name].max():.0f}")
        axes.set(xlabel="time (s)", ylabel="share of the largest", ylim=(0, 1.05), title="Growth")
        axes.legend(fontsize=8, loc="lower right")
    for panel in figure.axes:
        panel.grid(alpha=0.3)
        panel.tick_params(labelsize=8)
    return png(figure)


def _decibels(
    axes: Axes, seconds: NDArray[np.float64], quality: NDArray[np.float64], views: str, further: NextDecibel | None
) -> None:
    """The residual as dB below the data, and the time at which the next dB is expected."""
    axes.plot(seconds, quality, color="tab:green", lw=1.2, marker=".", ms=3)
    axes.set(xlabel="time (s)", ylabel="dB below the data", title=f"Residual, {views}")
    if further is None or seconds.size == 0:
        return
    if not further.measurable:
        axes.text(0.97, 0.05, "longer: no further dB", ha="right", fontsize=8, transform=axes.transAxes)
        return
    note = f"next dB of the {further.of}: about {duration_text(further.seconds)} more"
    axes.text(0.97, 0.05, note, ha="right", fontsize=8, transform=axes.transAxes)
    if further.of == "volume":
        return  # this curve is the residual, not the quality of the volume
    end, top = float(seconds[-1]), float(quality[-1])
    axes.plot([end, end + further.seconds], [top, top + 1], color="tab:green", lw=1, ls=":")
    high = further.high if math.isfinite(further.high) else 3 * further.seconds
    axes.plot([end + further.low, end + high], [top + 1, top + 1], color="0.4", lw=1)
    axes.plot([end + further.seconds], [top + 1], color="0.4", marker="|", ms=8)
