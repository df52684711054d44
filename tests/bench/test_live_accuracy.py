"""Accuracy against time of a live volume: by order of projections, on an idle and a busy machine, and at its end.

Run with  pytest -m bench -s tests/bench/test_live_accuracy.py ; about 3 minutes of CPU time. LIVE_FIGURE=PATH writes
the figure of docs/tradeoff.md. A busy machine is one that leaves the fit a twentieth of the steps. Seconds are those of
two cores that are all ours.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass, field

import numpy as np
import pytest

import recon
from recon.assess.metrics import psnr
from recon.base.method import Progress, ReconProblem, RunControl
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting.stream import StreamingFit
from recon.splatting.time_limit import FinalFit
from recon.warm_up import warm_up
from tests.bench.test_anytime_curve import ORDERS, VIEWS, Scan, particles, two_cores
from tests.clock import SteppedClock

STEPS_A_VIEW = {"quiet": 2.0, "busy": 0.1}
LOOKS = tuple(range(15, VIEWS + 1, 15))


@dataclass
class LiveCurve:
    """PSNR in dB of a live volume: at each look while views come, and against seconds after the last one."""

    shown: list[float] = field(default_factory=list)
    fit: list[float] = field(default_factory=list)
    direct: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    after: list[float] = field(default_factory=list)


def _live(scan: Scan, steps: float) -> LiveCurve:
    """A stream that takes so many steps between two views, and its last round."""
    data, geometry, truth = scan
    grid, found, clock, owed = Grid.matching(geometry), LiveCurve(), SteppedClock(tick=1.0), 0.0
    fit = StreamingFit(geometry, grid, now=lambda: clock.now())
    for view in range(VIEWS):
        fit.add_views(data[view : view + 1], geometry.angles[view : view + 1])
        owed += steps
        if owed >= 1:
            fit.advance(int(owed))
            owed -= int(owed)
        if view + 1 in LOOKS:
            found.shown.append(psnr(truth, fit.best_preview().volume.data))
            found.fit.append(psnr(truth, fit.snapshot().data))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of the part of the turn that is still missing
                by_fbp = recon.reconstruct(data[: view + 1], geometry.select(range(view + 1)), recon.Fbp(filter="hann"))
            found.direct.append(psnr(truth, np.maximum(by_fbp.volume.data, 0)))
    begin = two_cores()

    def look(progress: Progress) -> None:
        nonlocal begin
        now = two_cores()
        if not found.seconds or now - begin - found.seconds[-1] > 0.5:
            found.seconds.append(now - begin)
            found.after.append(psnr(truth, fit.snapshot().data))
            begin += two_cores() - now

    last = FinalFit(fit, recon.R2(), 1e9, 0.0, on_progress=look)
    made = last.run(ReconProblem(Views(data, geometry), grid), RunControl())
    found.seconds.append(two_cores() - begin)
    found.after.append(psnr(truth, made.volume.data))
    return found


def _line(name: str, values: list[float]) -> str:
    return f"| {name} | " + " | ".join(f"{value:.2f}" for value in values) + " |"


@pytest.mark.bench
@pytest.mark.timeout(7200)
def test_accuracy_against_time() -> None:
    warm_up()
    curves: dict[tuple[str, str], LiveCurve] = {}
    offline: dict[str, tuple[float, float]] = {}
    print(f"\n| views | {' | '.join(map(str, LOOKS))} | after the last round | s |")
    for order, angles in ORDERS.items():
        scan = particles(angles)
        for machine, steps in STEPS_A_VIEW.items():
            found = curves[order, machine] = _live(scan, steps)
            if machine == "quiet":
                print(_line(f"{order}, FBP", found.direct), flush=True)
            for name, values in (("fit", found.fit), ("shown", found.shown)):
                print(_line(f"{order}, {machine}, {name}", [*values, found.after[-1], found.seconds[-1]]), flush=True)
            best = np.maximum(found.fit, found.direct)
            print(f"shown is below the better by at most {np.max(best - found.shown):.2f} dB")
    data, geometry, truth = particles(ORDERS["sequential"])
    for name, method in (("r2", recon.R2()), ("auto", recon.Auto())):
        begin = two_cores()
        made = recon.reconstruct(data, geometry, method)
        offline[name] = two_cores() - begin, psnr(truth, made.volume.data)
        print(f"{name} of all views: {offline[name][1]:.2f} dB in {offline[name][0]:.1f} s", flush=True)
    if path := os.environ.get("LIVE_FIGURE"):
        _draw(path, curves, offline)
    ends = [found.after[-1] for found in curves.values()]
    assert max(ends) - min(ends) < 0.3
    assert min(ends) > offline["r2"][1] - 0.3


def _draw(path: str, curves: dict[tuple[str, str], LiveCurve], offline: dict[str, tuple[float, float]]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    during, after = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    for (order, machine), found in curves.items():
        colour = f"C{list(ORDERS).index(order)}"
        style = "-" if machine == "quiet" else "--"
        during.plot(LOOKS, found.shown, style, color=colour, label=f"{order}, {machine}")
        after.plot(found.seconds, found.after, style, color=colour, marker=".")
        if machine == "quiet":
            during.plot(LOOKS, found.direct, ":", color=colour, lw=1, label=f"{order}, FBP")
    for k, (name, (seconds, quality)) in enumerate(offline.items()):
        after.axhline(quality, color="0.4", ls=("-", "--")[k], lw=0.8, label=f"{name} of all views, {seconds:.0f} s")
    during.set(xlabel="views", ylabel="PSNR of the shown volume, dB")
    after.set(xlabel="s of two cores after the last view")
    for axes in (during, after):
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)
