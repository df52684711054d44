"""Plans: which settings of each method a trade-off tries, in which order, and how long the rest will take.

The registry of methods says which lengths of a method are tried; one without is tried with its defaults.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal

import numpy as np

from beamline.features.trials.trial import Outcome, Trial
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.method import Plain
from recon.base.volume import Grid
from recon.base.work import Rates, Span, costs_of, seconds_of
from recon.methods import METHODS, by_name, has_setting
from recon.splatting.r2 import R2
from recon.splatting.settings import FitSettings

Depth = Literal["quick", "full"]
Expected = Callable[[Trial], float | None]
"""s of a trial; None: not known."""

_WITH_HALVES = 3  # the half-set resolution takes two more reconstructions
_LEAST_OF_PART = 6  # views
_SHARES: Mapping[Depth, tuple[float, ...]] = {"quick": (0.5,), "full": (0.25, 0.5)}
_BASE_STEPS = {"quick": 250, "full": 1000}
_STEPS = {"quick": (60, 125, 250, 500), "full": (125, 250, 500, 1000, 2000)}
_FACTORS = {"quick": (0.25,), "full": (0.25, 0.5, 2.0)}
_BINNED_STEPS = {"quick": (250,), "full": (125, 500, 1000)}


@dataclass(frozen=True)
class TrialSettings:
    """One way in which a trade-off tries a method.

    Attributes:
        varies: the group of the trial: "method" for the baseline, else what differs from it.
        settings: that differ from the defaults, by name as `recon.methods.build` takes them.
        binning: of detector pixels.
    """

    varies: str
    settings: Mapping[str, Plain] = field(default_factory=dict)
    binning: int = 1


def trials_of(method: str, gaussians: int, depth: Depth) -> Sequence[TrialSettings]:
    """The settings that a trade-off tries on all views, the baseline first.

    Args:
        gaussians: how many a fit starts from by default.
        depth: "quick" has fewer trials, and shorter ones.
    """
    if (lengths := METHODS[method].lengths) is None:
        return _fits(gaussians, depth) if issubclass(by_name(method), R2) else [TrialSettings("method")]
    tried: Sequence[int] = getattr(lengths, depth)
    fixed: dict[str, Plain] = {"gaussians": gaussians} if has_setting(by_name(method), "gaussians") else {}
    settings = [{lengths.setting: length, **fixed} for length in tried]
    base, *others = [{}, *settings] if lengths.chosen else settings
    return [TrialSettings("method", base), *(TrialSettings(lengths.setting, each) for each in others)]


def _fits(gaussians: int, depth: Depth) -> list[TrialSettings]:
    base: dict[str, Plain] = {"steps": _BASE_STEPS[depth], "gaussians": gaussians}
    settings = [TrialSettings("method", base)]
    settings += [TrialSettings("steps", base | {"steps": n}) for n in _STEPS[depth] if n != base["steps"]]
    counts = [max(1, round(factor * gaussians)) for factor in _FACTORS[depth]]
    settings += [TrialSettings("gaussians", base | {"gaussians": count}) for count in counts]
    # A bin of two halves the detail across: a quarter of the Gaussians describes it.
    coarse = max(1, gaussians // 4)
    settings += [
        TrialSettings("binning", {"steps": steps, "gaussians": coarse}, binning=2) for steps in _BINNED_STEPS[depth]
    ]
    others = [kernel.value for kernel in Kernel if kernel is not FitSettings().kernel]
    settings += [TrialSettings("kernel", base | {"fit.kernel": name}) for name in others]
    settings.append(TrialSettings("start", base | {"start": "tv"}))
    settings.append(TrialSettings("loss", base | {"fit.ssim_weight": 0.0}))
    settings += [TrialSettings("loss", base | {"fit.loss": loss}) for loss in ("l2", "poisson")]
    settings.append(TrialSettings("rectification", base | {"fit.rays.rectified": False}))
    return settings


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
    first: list[Trial] = []
    rest: list[Trial] = []
    for method in methods:
        base, *others = (
            Trial(tried.varies, method, n_views, tried.binning, tried.settings)
            for tried in trials_of(method, gaussians, depth)
        )
        first.append(replace(base, halves=True))
        rest += [replace(base, group="views", views=n) for n in counts]
        rest += others
    return tuple(dict.fromkeys([*first, *rest]))


def quick_first(trials: Sequence[Trial], expected: Expected) -> tuple[Trial, ...]:
    """The trials with baselines first, then those that take least time, and those whose time is not known."""

    def order(trial: Trial) -> tuple[bool, float]:
        varied = trial.group != "method"
        return varied, (expected(trial) or math.inf) if varied else 0.0

    return tuple(sorted(trials, key=order))


def plan_in_equal_time(methods: Sequence[str], n_views: int, gaussians: int, seconds: float) -> tuple[Trial, ...]:
    """Each method once, all with the same time."""
    return tuple(base.in_time(seconds) for base in _baselines(methods, n_views, gaussians))


def telling_first(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """The trials in an order for little time: each method once, direct ones first, without half-set resolutions.

    These take two more reconstructions each, and say less than one of another method.
    """
    once = [replace(trial, halves=False) for trial in trials]
    alone = [trial for trial in once if trial.group == "method"]
    direct = [trial for trial in alone if by_name(trial.method).traits.direct]
    return tuple(dict.fromkeys([*direct, *alone, *once]))


def plan_in_time(methods: Sequence[str], n_views: int, gaussians: int, volumes: int) -> tuple[Trial, ...]:
    """Each method ignoring time, then of parts of the views; one fit of so many volumes without and with motion."""
    alone = _baselines(methods, n_views, gaussians)
    numbers = sorted({n for n in (2, volumes, 2 * volumes) if n_views // n >= _LEAST_OF_PART})
    settings: list[dict[str, Plain | None]] = [{"volumes": volumes, "moves": moves} for moves in (False, True, None)]
    jointly = [Trial("one fit", "series", n_views, settings=each) for each in settings]
    return *alone, *(replace(base, group="parts", parts=n) for n in numbers for base in alone), *jointly


def plan_of_energies(
    methods: Sequence[str], n_views: int, gaussians: int, energies: int, materials: Sequence[str], states: Sequence[str]
) -> tuple[Trial, ...]:
    """Each energy by itself with each method, then one fit of all materials, and with the share of two states."""
    alone = [replace(base, group="parts", parts=energies) for base in _baselines(methods, n_views, gaussians)]
    names: dict[str, Plain | None] = {"materials": ",".join(materials)}
    jointly = [Trial("one fit", "materials", n_views, settings=names)]
    jointly += [replace(jointly[0], settings={**names, "states": ",".join(states)})] if states else []
    return *alone, *jointly


def _baselines(methods: Sequence[str], n_views: int, gaussians: int) -> list[Trial]:
    """In short runs."""
    first = [trials_of(method, gaussians, "quick")[0] for method in methods]
    return [
        Trial("method", name, n_views, settings=baseline.settings)
        for name, baseline in zip(methods, first, strict=True)
    ]


@dataclass(frozen=True)
class Timed:
    """A finished trial, and how its time was spent.

    Attributes:
        wall: s, from before its process began to after its end.
        working: s of these that it reconstructed, which grow with the work; the rest is the same for all.
    """

    trial: Trial
    wall: float
    working: float

    @classmethod
    def of(cls, outcome: Outcome, wall: float) -> Timed:
        """The times of a trial that has ended; one without figures has 0 s of work."""
        seconds = outcome.seconds * (_WITH_HALVES if outcome.trial.halves else 1)
        return cls(outcome.trial, wall, min(wall, seconds) if math.isfinite(seconds) else 0.0)


def expected_seconds(geometry: Geometry, rates: Rates) -> Expected:
    """s that a trial on some of these views reconstructs, at most.

    None: not known before it is tried; that is also where its method refuses the views, which the trial will report.
    """

    @cache
    def of_trial(trial: Trial) -> float | None:
        with suppress(ValueError):
            return None if (span := _span(trial, geometry, rates)) is None else span.most
        return None

    return of_trial


def _span(trial: Trial, geometry: Geometry, rates: Rates) -> Span | None:
    some = geometry.select(np.arange(trial.views) * geometry.n_views // trial.views)
    method = trial.build()
    if trial.seconds_asked is not None and not method.traits.own_length:
        return Span(trial.seconds_asked, trial.seconds_asked)
    coarse = some.binned(trial.binning)
    parts = [coarse.select(views) for views in np.array_split(np.arange(trial.views), trial.parts)]
    if trial.halves:
        parts += [coarse.select(slice(first, None, 2)) for first in (0, 1)]
    each = [costs_of(method, [(part, Grid.matching(part))]) for part in parts]
    spans = [seconds_of(costs, rates) for costs in each if costs is not None]
    if not spans:
        return None
    limit = math.inf if trial.seconds_asked is None else trial.seconds_asked
    return Span(*(min(limit, sum(ends)) for ends in zip(*spans, strict=True)))


def trials_left(done: Sequence[Timed], trials: Sequence[Trial], expected: Expected) -> float | None:
    """s that the trials to come will take, from those done; None before the first.

    Each takes the same time to start and measure, and what is expected of it, at the pace of its method's trials that
    are done, or of all. One of which nothing is expected takes what those of its method did, or all.
    """
    if not done:
        return None
    total = len(trials) * sum(each.wall - each.working for each in done) / len(done)
    # a direct method is over too soon to tell how fast this machine is
    pace = _pace([each for each in done if not each.trial.direct], expected) or 1.0
    for trial in trials:
        same = [each for each in done if each.trial.method == trial.method and each.working > 0]
        if trial.seconds_asked is not None:
            total += trial.seconds_asked
        elif (seconds := expected(trial)) is not None:
            total += seconds * (_pace(same, expected) or pace)
        else:
            total += sum(each.working for each in same or done) / len(same or done)
    return total


def _pace(done: Sequence[Timed], expected: Expected) -> float | None:
    """What trials took over what was expected of them; None where nothing was."""
    told = [(seconds, each.working) for each in done if each.working > 0 and (seconds := expected(each.trial))]
    return sum(taken for _, taken in told) / sum(seconds for seconds, _ in told) if told else None
