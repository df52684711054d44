"""Trade-off: which trials it compares.

The registry of methods says which lengths of a method are tried; one without is tried with its defaults.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Literal

from beamline.core.events import TradeoffStarted
from beamline.core.sinks import Warn
from beamline.features.trials.runner import ComparedScan, Planned, opened_scan
from beamline.features.trials.trial import Outcome, Trial
from recon.base.kernel import Kernel
from recon.base.method import Plain
from recon.methods import METHODS, by_name, has_setting, names_compared
from recon.splatting.initialise import default_count
from recon.splatting.r2 import R2
from recon.splatting.settings import FitSettings

Depth = Literal["quick", "full"]

_SHARES: Mapping[Depth, tuple[float, ...]] = {"quick": (0.5,), "full": (0.25, 0.5)}
_BASE_STEPS = {"quick": 250, "full": 1000}
_STEPS = {"quick": (60, 125, 250, 500), "full": (125, 250, 500, 1000, 2000)}
_FACTORS = {"quick": (0.25,), "full": (0.25, 0.5, 2.0)}
_BINNED_STEPS = {"quick": (250,), "full": (125, 500, 1000)}


def planned_tradeoff(scan: ComparedScan, warn: Warn, depth: Depth = "quick") -> Planned:
    """Read and correct the views, hold some out where there is no truth, and plan the trials.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    data, table = opened_scan(scan, "tradeoff", "What accuracy costs", warn, held_out=True)
    geometry = data.geometry
    gaussians = default_count(geometry, geometry.sample_pitch)
    methods = scan.methods or names_compared()
    if scan.seconds is None:
        trials = plan(methods, geometry.n_views, gaussians, depth)
    else:
        trials = plan_in_equal_time(methods, geometry.n_views, gaussians, scan.seconds)
    if scan.max_seconds is not None:
        trials = telling_first(trials)
    table = replace(
        table,
        outcomes=tuple(Outcome(trial, "not run") for trial in trials),
        scan={**table.scan, "views used": str(geometry.n_views)},
    )
    return Planned(data, table, TradeoffStarted(scan.source.path, len(trials), table.by))


def trials_of(method: str, n_views: int, gaussians: int, depth: Depth) -> list[Trial]:
    """The settings that are tried on all views, the baseline first.

    Args:
        gaussians: how many a fit starts from by default.
        depth: "quick" has fewer trials, and shorter ones.
    """
    if (lengths := METHODS[method].lengths) is None:
        fits = issubclass(by_name(method), R2)
        return _fits(method, n_views, gaussians, depth) if fits else [Trial("method", method, n_views)]
    tried: Sequence[int] = getattr(lengths, depth)
    fixed: dict[str, Plain] = {"gaussians": gaussians} if has_setting(by_name(method), "gaussians") else {}
    settings = [{lengths.setting: length, **fixed} for length in tried]
    base, *others = [{}, *settings] if lengths.chosen else settings
    varied = [Trial(lengths.setting, method, n_views, settings=each) for each in others]
    return [Trial("method", method, n_views, settings=base), *varied]


def _fits(method: str, n_views: int, gaussians: int, depth: Depth) -> list[Trial]:
    usual: dict[str, Plain] = {"steps": _BASE_STEPS[depth], "gaussians": gaussians}
    # A bin of two halves the detail across: a quarter of the Gaussians describes it.
    coarse = max(1, gaussians // 4)
    changes: list[tuple[str, Mapping[str, Plain]]] = [
        ("method", {}),
        *(("steps", {"steps": n}) for n in _STEPS[depth] if n != usual["steps"]),
        *(("gaussians", {"gaussians": max(1, round(factor * gaussians))}) for factor in _FACTORS[depth]),
        *(("binning", {"steps": n, "gaussians": coarse}) for n in _BINNED_STEPS[depth]),
        *(("kernel", {"fit.kernel": kernel.value}) for kernel in Kernel if kernel is not FitSettings().kernel),
        ("start", {"start": "tv"}),
        ("loss", {"fit.ssim_weight": 0.0}),
        *(("loss", {"fit.loss": loss}) for loss in ("l2", "poisson")),
        ("rectification", {"fit.rays.rectified": False}),
    ]
    return [
        Trial(group, method, n_views, 2 if group == "binning" else 1, {**usual, **changed})
        for group, changed in changes
    ]


def plan(methods: Sequence[str], n_views: int, gaussians: int, depth: Depth) -> tuple[Trial, ...]:
    """The trials, one setting varied at a time about each method's baseline; baselines first.

    Args:
        methods: names in `recon.methods`, in the order wanted.
        gaussians: how many a fit would start from by itself.
        depth: "quick" has about half as many trials as "full", and shorter ones.

    Raises:
        ValueError: for a method that there is not.
    """
    counts = sorted({max(2, round(share * n_views)) for share in _SHARES[depth]} - {n_views})
    tried = [trials_of(method, n_views, gaussians, depth) for method in methods]
    fewer = [[replace(base, group="views", views=n) for n in counts] + others for base, *others in tried]
    return tuple(dict.fromkeys([*(replace(base, halves=True) for base, *_ in tried), *chain(*fewer)]))


def plan_in_equal_time(methods: Sequence[str], n_views: int, gaussians: int, seconds: float) -> tuple[Trial, ...]:
    """Each method once, all with the same time."""
    return tuple(trials_of(method, n_views, gaussians, "quick")[0].in_time(seconds) for method in methods)


def telling_first(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """The trials in an order for little time: each method once, direct ones first, without half-set resolutions.

    These take two more reconstructions each, and say less than one of another method.
    """
    once = [replace(trial, halves=False) for trial in trials]
    alone = sorted((t for t in once if t.group == "method"), key=lambda t: not by_name(t.method).traits.direct)
    return tuple(dict.fromkeys([*alone, *once]))
