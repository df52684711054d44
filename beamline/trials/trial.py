"""Trials: which settings a trade-off tries, in which order, and how long the rest will take; pure values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal

from beamline.trials.varied import JOINT, MOTION, Depth, ended_by_time, trials_of, work_of
from recon.base.method import Method, Plain
from recon.methods import build, by_name

Status = Literal["done", "failed", "out of time", "interrupted", "not run"]

_WITH_HALVES = 3  # the half-set resolution takes two more reconstructions
_LEAST_OF_PART = 6  # views
_SHARES: Mapping[Depth, tuple[float, ...]] = {"quick": (0.5,), "full": (0.25, 0.5)}


@dataclass(frozen=True)
class Trial:
    """One reconstruction to make.

    Attributes:
        group: what it varies: "method" where nothing.
        method: its name in `recon.methods`, or in `beamline.trials.varied.JOINT`.
        views: how many, spread evenly over those chosen.
        binning: of detector pixels, on top of the selection's.
        settings: of the method, by name as `recon.methods.build` takes them.
        halves: measure the half-set resolution too, which takes two more reconstructions.
        parts: of the views, in time or by energy, each reconstructed by itself.
        seconds_asked: after which a reconstruction ends; None: when its work is done.
    """

    group: str
    method: str
    views: int
    binning: int = 1
    settings: Mapping[str, Plain] = field(default_factory=dict, hash=False)
    halves: bool = False
    parts: int = 1
    seconds_asked: float | None = None

    def build(self) -> Method:
        """The method with the settings of the trial.

        Raises:
            ValueError: for a method or a setting that there is not.
        """
        method, seconds = by_name(self.method), self.seconds_asked
        return build(method, {**self.settings, **({} if seconds is None else ended_by_time(method, seconds))})

    @property
    def label(self) -> str:
        """The settings in a few words."""
        parts = [self.method, f"{self.views} views"]
        parts += [f"bin {self.binning}"] if self.binning > 1 else []
        parts += [f"{self.parts} parts"] if self.parts > 1 else []
        parts += [f"{self.seconds_asked:g} s"] if self.seconds_asked is not None else []
        return ", ".join([*parts, *(_in_words(name, value) for name, value in self.settings.items())])

    @property
    def title(self) -> str:
        """Of its slice in a picture."""
        if self.group == "method":
            return by_name(self.method).label
        told = self.settings if self.method in JOINT else {}
        parts = [f"{self.parts} parts"] if self.parts > 1 else []
        return ", ".join([self.method, *parts, *(_in_words(name, value) for name, value in told.items())])

    def as_record(self) -> dict[str, Any]:
        """Plain values for a table, JSON or an event."""
        record = {f.name: getattr(self, f.name) for f in fields(self)}
        return {**record, **record.pop("settings"), "label": self.label}


def _in_words(name: str, value: Plain) -> str:
    match name, value:
        case "steps", _:
            return f"{value} steps"
        case "gaussians", int():
            return thousands(value)
        case "volumes", _:
            return f"{value} volumes"
        case "motion", _:
            return f"motion {value}"
        case "share", _:
            return "smooth share"
        case "iterations", _:
            return f"{value} iteration{'s' * (value != 1)}"
        case "fit.loss", _:
            return f"{value} loss"
        case "fit.ssim_weight", 0:
            return "no SSIM"
        case "fit.kernel", _:
            return f"{value} kernel"
    return f"{name.rsplit('.', 1)[-1]} {value}"


@dataclass(frozen=True)
class Outcome:
    """What became of a trial.

    Attributes:
        status: only "done" comes with figures.
        seconds: wall time of the reconstruction, without compilation and measuring.
        peak_bytes: of its process; None where the system does not tell.
        metrics: psnr, ssim3d (with a truth), residual_held_out, resolution (mm), by name.
        gaussians: in the model at the end; None for voxel methods.
        curve: (seconds, dB) of its own record of the residual.
        curve_of: which views that record is of, in words.
        cpu_seconds: of all threads of the reconstruction; the ones to compare on a machine that others use, too.
        left: squared residual of each view held out.
        reached: how far it came, such as "212 steps, 8 sweeps"; empty for a direct method.
    """

    trial: Trial
    status: Status
    seconds: float = math.nan
    peak_bytes: int | None = None
    metrics: Mapping[str, float] = field(default_factory=dict)
    gaussians: int | None = None
    curve: Sequence[tuple[float, float]] = ()
    curve_of: str = ""
    message: str = ""
    cpu_seconds: float = math.nan
    left: Sequence[float] = ()
    reached: str = ""

    def quality(self, by: str) -> float:
        """dB by "psnr", or by "residual_held_out" as -20 log10 of it; NaN where it is not known."""
        return decibels(by, self.metrics.get(by, math.nan))

    def as_record(self) -> dict[str, Any]:
        """Plain values for a table or JSON."""
        return {**asdict(self), "trial": self.trial.as_record()}


def decibels(name: str, value: float) -> float:
    """A metric as dB, more being better: PSNR as it is, a residual r as -20 log10 r."""
    if name != "residual_held_out":
        return value
    return -20 * math.log10(value) if value > 0 else math.nan


def thousands(n: int) -> str:
    return f"{n / 1000:.3g}k Gaussians" if n >= 1000 else f"{n} Gaussians"


def plan(methods: Sequence[str], n_views: int, gaussians: int, depth: Depth) -> tuple[Trial, ...]:
    """The trials, one setting varied at a time about each method's baseline; baselines first, cheap ones early.

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
    return tuple(dict.fromkeys([*first, *sorted(rest, key=work)]))


def in_time(trial: Trial, seconds: float | None) -> Trial:
    """The trial, to end when its seconds are over, if any; a direct method takes what it takes."""
    method = by_name(trial.method)
    if seconds is None or method.traits.direct:
        return trial
    by_time = ended_by_time(method, seconds)
    kept = {name: value for name, value in trial.settings.items() if name not in by_time}
    return replace(trial, settings=kept, seconds_asked=seconds)


def plan_in_equal_time(methods: Sequence[str], n_views: int, gaussians: int, seconds: float) -> tuple[Trial, ...]:
    """Each method once, all with the same time."""
    return tuple(in_time(base, seconds) for base in _baselines(methods, n_views, gaussians))


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
    joint = [Trial("one fit", "series", n_views, settings={"volumes": volumes, "motion": how}) for how in MOTION]
    return *alone, *(replace(base, group="parts", parts=n) for n in numbers for base in alone), *joint


def plan_of_energies(
    methods: Sequence[str], n_views: int, gaussians: int, energies: int, states: bool
) -> tuple[Trial, ...]:
    """Each energy by itself with each method, then one fit of all materials, and with the share of two states."""
    alone = [replace(base, group="parts", parts=energies) for base in _baselines(methods, n_views, gaussians)]
    joint = [Trial("one fit", "materials", n_views)]
    joint += [Trial("one fit", "materials", n_views, settings={"share": True})] if states else []
    return *alone, *joint


def _baselines(methods: Sequence[str], n_views: int, gaussians: int) -> list[Trial]:
    """In short runs."""
    first = [trials_of(method, gaussians, "quick")[0] for method in methods]
    return [Trial("method", name, n_views, settings=one.settings) for name, one in zip(methods, first, strict=True)]


def work(trial: Trial) -> float:
    """A rough number for how long a trial takes, to be compared within one method only."""
    if trial.method in JOINT:
        return trial.views * JOINT[trial.method](trial.settings)
    return work_of(trial.build(), trial.views, trial.binning) * (_WITH_HALVES if trial.halves else 1)


@dataclass(frozen=True)
class Timed:
    """A trial that is done, and where its time went.

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


def seconds_left(done: Sequence[Timed], left: Sequence[Trial]) -> float | None:
    """How long the trials that are left will take, from those done; None before the first.

    Each takes the same time to start and measure, and more in proportion to its work. Work is compared within a method;
    a method not yet seen is taken to cost what the others did on average, and one with a time to take it.
    """
    if not done:
        return None
    fixed = sum(one.wall - one.working for one in done) / len(done)
    typical = sum(one.working for one in done) / len(done)
    total = 0.0
    for trial in left:
        if trial.seconds_asked is not None:
            total += fixed + trial.seconds_asked
            continue
        same = [one for one in done if one.trial.method == trial.method and one.working > 0]
        amount = sum(work(one.trial) for one in same)
        total += fixed + (work(trial) * sum(one.working for one in same) / amount if amount > 0 else typical)
    return total
