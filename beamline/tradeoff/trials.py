"""Trials: which settings a trade-off tries, in which order, and how long the rest will take; pure values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from recon.reconstruction import Method
from recon.splatting.initialise import Start

Loss = Literal["l1+ssim", "l1", "l2+ssim", "poisson+ssim"]
Depth = Literal["quick", "full"]
Status = Literal["done", "failed", "out of time", "interrupted", "not run"]

DIRECT = ("fbp",)
_WITH_HALVES = 3  # the half-set resolution takes two more reconstructions
SIGMAS = 3.5  # where the fit cuts Gaussians off when nobody says otherwise

_STEPS: Mapping[Depth, tuple[int, ...]] = {"quick": (60, 125, 250, 500), "full": (125, 250, 500, 1000, 2000)}
_BASE_STEPS: Mapping[Depth, int] = {"quick": 250, "full": 1000}
_BINNED_STEPS: Mapping[Depth, tuple[int, ...]] = {"quick": (250,), "full": (125, 500, 1000)}
_SHARES: Mapping[Depth, tuple[float, ...]] = {"quick": (0.5,), "full": (0.25, 0.5)}
_FACTORS: Mapping[Depth, tuple[float, ...]] = {"quick": (0.5,), "full": (0.5, 2.0)}
_SIGMAS: Mapping[Depth, tuple[float, ...]] = {"quick": (3.0,), "full": (2.5, 3.0, 4.5)}
_LOSSES: tuple[Loss, ...] = ("l1", "l2+ssim", "poisson+ssim")
# Passes over the data; about what each method needs to get near its best, and a few fewer and more.
_ITERATIONS: Mapping[str, Mapping[Depth, tuple[int, ...]]] = {
    "sirt": {"quick": (20, 60), "full": (10, 30, 100, 300)},
    "sart": {"quick": (2, 6), "full": (1, 3, 10, 30)},
    "cgls": {"quick": (5, 15), "full": (5, 10, 20, 40)},
    "asd-pocs": {"quick": (10,), "full": (5, 20, 50)},
    "fista-tv": {"quick": (20, 60), "full": (20, 50, 100, 200)},
    "os-sirt-tv": {"quick": (5, 15), "full": (5, 10, 20, 40)},
}


@dataclass(frozen=True)
class Trial:
    """One reconstruction to make.

    Attributes:
        group: what it varies: "method" where nothing, "precision" for the comparison with the float64 twin.
        method: of recon.reconstruct.
        views: how many, spread evenly over those chosen.
        binning: detector pixels joined a side, on top of the selection's.
        steps, gaussians, loss, sigmas: of the r2 fit; how many Gaussians it starts from, where they are cut off.
        start: the volume that the fit's Gaussians are drawn from.
        iterations: of the classical methods.
        halves: measure the half-set resolution too, which takes two more reconstructions.
    """

    group: str
    method: Method
    views: int
    binning: int = 1
    steps: int | None = None
    gaussians: int | None = None
    loss: Loss = "l1+ssim"
    sigmas: float = SIGMAS
    start: Start = "fbp"
    iterations: int | None = None
    halves: bool = False

    @property
    def label(self) -> str:
        """The settings, as short as they can be said."""
        if self.group == "precision":
            return "float32 against float64"
        parts = [self.method, f"{self.views} views"]
        parts += [f"bin {self.binning}"] if self.binning > 1 else []
        parts += [f"{self.steps} steps"] if self.steps is not None else []
        parts += [thousands(self.gaussians)] if self.gaussians is not None else []
        parts += [self.loss] if self.loss != "l1+ssim" else []
        parts += [f"cut at {self.sigmas:g} σ"] if self.sigmas != SIGMAS else []
        parts += [f"start {self.start}"] if self.start != "fbp" else []
        parts += [f"{self.iterations} iteration{'s' * (self.iterations != 1)}"] if self.iterations is not None else []
        return ", ".join(parts)


@dataclass(frozen=True)
class Outcome:
    """What became of a trial.

    Attributes:
        trial: what was tried.
        status: only "done" comes with figures.
        seconds: wall time of the reconstruction, without compilation and measuring.
        peak_bytes: of its process; None where the system does not tell.
        metrics: psnr, ssim3d (with a truth), residual_held_out, resolution (mm), by name.
        gaussians: in the model at the end; None for voxel methods.
        curve: (seconds, dB) of its own record of the residual.
        curve_of: of which views that is, in words.
        message: why there are no figures.
        details: of the comparison with the float64 twin.
        cpu_seconds: of all threads of the reconstruction; the ones to compare on a machine that others use, too.
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
    details: Mapping[str, float] = field(default_factory=dict)
    cpu_seconds: float = math.nan

    def quality(self, by: str) -> float:
        """dB by "psnr", or by "residual_held_out" as -20 log10 of it; NaN where it is not known."""
        return decibels(by, self.metrics.get(by, math.nan))

    def as_record(self) -> dict[str, Any]:
        """Plain values for a table or JSON."""
        record = asdict(self)
        record["trial"]["label"] = self.trial.label
        return record


def decibels(name: str, value: float) -> float:
    """A metric as dB, more being better: PSNR as it is, a residual r as -20 log10 r."""
    if name != "residual_held_out":
        return value
    return -20 * math.log10(value) if value > 0 else math.nan


def thousands(n: int) -> str:
    return f"{n / 1000:.3g}k Gaussians" if n >= 1000 else f"{n} Gaussians"


def plan(methods: Sequence[Method], n_views: int, gaussians: int, depth: Depth) -> tuple[Trial, ...]:
    """The trials, one setting varied at a time about each method's baseline; baselines first, cheap ones early.

    Args:
        methods: of recon.reconstruct, in the order wanted.
        n_views: how many there are.
        gaussians: how many the r2 fit would start from by itself.
        depth: "quick" has about half as many trials as "full", and shorter ones.
    """
    first: list[Trial] = []
    rest: list[Trial] = []
    for method in methods:
        base, *others = _of_method(method, n_views, gaussians, depth)
        first.append(base)
        rest += others
    unique = dict.fromkeys([*first, *sorted(rest, key=work)])
    return tuple(unique) + ((Trial("precision", "r2", n_views),) if "r2" in methods else ())


def _of_method(method: Method, n_views: int, gaussians: int, depth: Depth) -> list[Trial]:
    counts = sorted({max(2, round(share * n_views)) for share in _SHARES[depth]} - {n_views})
    if method in DIRECT:
        base = Trial("method", method, n_views, halves=True)
        return [base, *(replace(base, group="views", views=n, halves=False) for n in counts)]
    if method in _ITERATIONS:
        numbers = _ITERATIONS[method][depth]
        base = Trial("method", method, n_views, iterations=numbers[len(numbers) // 2], halves=True)
        plain = replace(base, halves=False)
        trials = [base, *(replace(plain, group="iterations", iterations=n) for n in numbers if n != base.iterations)]
        return trials + [replace(plain, group="views", views=n) for n in counts]
    base = Trial("method", method, n_views, steps=_BASE_STEPS[depth], gaussians=gaussians, halves=True)
    plain = replace(base, halves=False)
    trials = [base, *(replace(plain, group="steps", steps=n) for n in _STEPS[depth] if n != base.steps)]
    trials += [replace(plain, group="views", views=n) for n in counts]
    trials += [replace(plain, group="gaussians", gaussians=max(1, round(f * gaussians))) for f in _FACTORS[depth]]
    # A bin of two halves the detail across: a quarter of the Gaussians describes it.
    coarse = replace(plain, group="binning", binning=2, gaussians=max(1, gaussians // 4))
    trials += [replace(coarse, steps=n) for n in _BINNED_STEPS[depth]]
    trials += [replace(plain, group="cut-off", sigmas=s) for s in _SIGMAS[depth]]
    trials.append(replace(plain, group="start", start="tv"))
    return trials + [replace(plain, group="loss", loss=loss) for loss in _LOSSES]


def work(trial: Trial) -> float:
    """A rough number for how long a trial takes, to be compared within one method only."""
    amount = trial.views * (trial.iterations or 1) / trial.binning**3
    if trial.steps is not None:
        per_step = 1 + (trial.gaussians or 0) / 2e4 * (trial.sigmas / SIGMAS) ** 2
        amount = trial.steps * per_step
    return amount * (_WITH_HALVES if trial.halves else 1)


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
        """What is known of a trial that has ended; one without figures has told nothing of its work."""
        made = outcome.seconds * (_WITH_HALVES if outcome.trial.halves else 1)
        return cls(outcome.trial, wall, min(wall, made) if math.isfinite(made) else 0.0)


def seconds_left(done: Sequence[Timed], left: Sequence[Trial]) -> float | None:
    """How long the trials that are left will take, from those done; None before the first.

    Each takes the same time to start and measure, and more in proportion to its work. Work is compared within a method;
    a method not yet seen is taken to cost what the others did on average.
    """
    if not done:
        return None
    fixed = sum(one.wall - one.working for one in done) / len(done)
    typical = sum(one.working for one in done) / len(done)
    total = 0.0
    for trial in left:
        same = [one for one in done if one.trial.method == trial.method and one.working > 0]
        amount = sum(work(one.trial) for one in same)
        total += fixed + (work(trial) * sum(one.working for one in same) / amount if amount > 0 else typical)
    return total
