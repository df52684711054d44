"""Trial: one reconstruction to make, and what became of it; the table of all trials, and their Pareto front."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np

from beamline.core.text import count
from beamline.features.trials.view_choices import ViewChoice
from beamline.projections.scan_statistics import Light
from recon.base.method import Method, Plain
from recon.methods import build, by_name, has_setting

Status = Literal["done", "failed", "out of time", "interrupted", "not run"]

_NAMES = ("materials", "states")  # settings that are several names
LEAST_GAIN = 0.01  # dB: the smallest difference that tables show
_ERRORS = 2.0  # standard errors, of the difference over the views held out, that chance may reach
_WITH_HALVES = 3  # reconstructions of a trial with its half-set resolution
_ENDLESS = 10**6  # steps or iterations: a time ends the run long before


@dataclass(frozen=True)
class Trial:
    """One reconstruction to make.

    Attributes:
        group: what it varies: "method" where nothing.
        method: its name in `recon.methods`.
        views: how many, spread evenly over those of the scan, or as many as `choice` has.
        binning: of detector pixels, on top of the selection's.
        settings: of the method, by name as `recon.methods.build` takes them; of names a text, with commas.
        halves: measure the half-set resolution too, which takes two more reconstructions.
        parts: of the views, in time or by energy, each reconstructed by itself.
        seconds_asked: after which a reconstruction ends; None: when its work is done.
        choice: which views; None: `views` of them, evenly spread.
    """

    group: str
    method: str
    views: int
    binning: int = 1
    settings: Mapping[str, Plain | bool | None] = field(default_factory=dict, hash=False)
    halves: bool = False
    parts: int = 1
    seconds_asked: float | None = None
    choice: ViewChoice | None = None

    @property
    def left_out(self) -> bool:
        """The scan has not the views that it asks for."""
        return self.choice is not None and self.choice.groups is None

    @property
    def frames(self) -> int:
        """Frames of the scan that it takes, each counted once: its dose."""
        return self.views if self.choice is None else self.choice.frames

    @property
    def facts(self) -> Mapping[str, float]:
        """On how its views were taken, by heading."""
        return {} if self.choice is None else self.choice.facts

    def build(self) -> Method:
        """The method with the settings of the trial.

        Raises:
            ValueError: for a method or a setting that there is not.
        """
        method, seconds = by_name(self.method), self.seconds_asked
        settings = {name: str(value).split(",") if name in _NAMES else value for name, value in self.settings.items()}
        return build(method, {**settings, **({} if seconds is None else ended_by_time(method, seconds))})

    def in_time(self, seconds: float | None) -> Trial:
        """The trial, to end when its seconds are over, if any; a direct method takes what it takes."""
        method = by_name(self.method)
        if seconds is None or method.traits.direct:
            return self
        by_time = ended_by_time(method, seconds)
        kept = {name: value for name, value in self.settings.items() if name not in by_time}
        return replace(self, settings=kept, seconds_asked=seconds)

    @property
    def label(self) -> str:
        """The settings in a few words."""
        if self.choice is not None:
            return f"{self.choice.label}: {self.method}"
        parts = [self.method, f"{self.views} views"]
        parts += [f"bin {self.binning}"] if self.binning > 1 else []
        parts += [f"{self.parts} parts"] if self.parts > 1 else []
        parts += [f"{self.seconds_asked:g} s"] if self.seconds_asked is not None else []
        return ", ".join([*parts, *self._settings_in_words])

    @property
    def _settings_in_words(self) -> list[str]:
        return [words for name, value in self.settings.items() if (words := _in_words(name, value))]

    @property
    def title(self) -> str:
        """Of its slice in a picture."""
        if self.choice is not None:
            return self.label
        if self.group == "method":
            return by_name(self.method).label
        parts = [f"{self.parts} parts"] if self.parts > 1 else []
        return ", ".join(
            [self.method, *parts, *(self._settings_in_words if by_name(self.method).traits.several else [])]
        )

    def as_record(self) -> dict[str, Any]:
        """Plain values for a table, JSON or an event."""
        record = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "choice"}
        return {**record, **record.pop("settings"), "label": self.label}


def ended_by_time(method: type[Method], seconds: float) -> dict[str, Plain]:
    """The settings with which so many seconds, and nothing else, end a run of the method; see `Traits.own_length`."""
    if method.traits.own_length:
        return {}
    lengths: dict[str, Plain] = {"seconds": seconds, "steps": _ENDLESS, "iterations": _ENDLESS}
    return {name: value for name, value in lengths.items() if has_setting(method, name)}


_WORDS: Mapping[str, Callable[[Any], str]] = {
    "steps": lambda n: f"{n} steps",
    "gaussians": lambda n: f"{n / 1000:.3g}k Gaussians" if isinstance(n, int) and n >= 1000 else f"{n} Gaussians",
    "volumes": lambda n: f"{n} volumes",
    "moves": lambda moves: f"motion {'chosen' if moves is None else 'learnt' if moves else 'none'}",
    "states": lambda names: "smooth share",
    "materials": lambda names: "",
    "iterations": lambda n: count(n, "iteration"),
    "fit.loss": lambda name: f"{name} loss",
    "fit.ssim_weight": lambda weight: f"ssim_weight {weight}" if weight else "no SSIM",
    "fit.kernel": lambda name: f"{name} kernel",
}


def _in_words(name: str, value: Plain | None) -> str:
    return _WORDS[name](value) if name in _WORDS else f"{name.rsplit('.', 1)[-1]} {value}"


HELD_OUT = "residual_held_out"
QUALITIES = {
    "psnr": ("PSNR", "PSNR (dB)"),
    "psnr_all": ("PSNR", "PSNR (dB)"),
    HELD_OUT: ("−20 log₁₀ of the held-out residual", "held-out residual (dB below the data)"),
}
"""The measures that trials are compared by, in words and as the label of an axis, by the name of the metric."""


@dataclass(frozen=True)
class Outcome:
    """Result of a trial.

    Attributes:
        status: only "done" comes with figures.
        seconds: wall time of the reconstruction, without compilation and measuring.
        peak_bytes: of its process; None where the system does not tell.
        metrics: psnr, ssim3d (with a truth), residual_held_out, resolution (mm), and with a reference psnr_all,
            ssim_all, snr, cnr; by name.
        gaussians: in the model at the end; None for voxel methods.
        curve: (seconds, dB) of its own record of the residual.
        curve_of: which views that record is of, in words.
        cpu_seconds: of all threads of the reconstruction; the ones to compare on a machine that others use, too.
        squared_residuals: of each view held out.
        reached: how far it came, such as "212 steps, 8 sweeps"; empty for a direct method.
        wall: s, from before its process began to after its end.
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
    squared_residuals: Sequence[float] = ()
    reached: str = ""
    wall: float = math.nan

    @property
    def working(self) -> float:
        """s of `wall` that grow with the work, half-set resolution included; 0 without figures."""
        seconds = self.seconds * (_WITH_HALVES if self.trial.halves else 1)
        return min(self.wall, seconds) if math.isfinite(seconds) else 0.0

    def quality(self, by: str) -> float:
        """dB, more is better, by the metric of this name, of `QUALITIES`; NaN where it is not known."""
        value = self.metrics.get(by, math.nan)
        if by != HELD_OUT:
            return value
        return -20 * math.log10(value) if value > 0 else math.nan

    def as_record(self) -> dict[str, Any]:
        """Plain values for a table or JSON."""
        return {f.name: getattr(self, f.name) for f in fields(self)} | {"trial": self.trial.as_record()}


@dataclass(frozen=True)
class TrialCost:
    """A cost of a trial, and how a picture shows it.

    Attributes:
        name: in file names; `words`: in titles and captions.
        axis: label with its unit; `scale`: from the value to that unit; `unit`: alone.
        of: the cost of an outcome; NaN where it is not known.
    """

    name: str
    words: str
    axis: str
    scale: float
    of: Callable[[Outcome], float]
    unit: str


TIME = TrialCost("seconds", "time", "time (s)", 1.0, lambda outcome: outcome.seconds, "s")
MEMORY = TrialCost(
    "memory", "memory", "peak memory of the process (MB)", 1e-6,
    lambda outcome: math.nan if outcome.peak_bytes is None else float(outcome.peak_bytes),
    "MB",
)  # fmt: skip


@dataclass(frozen=True)
class TrialTable:
    """All trials of a scan, with the scan and the machine that they ran on.

    Attributes:
        outcomes: in the order of the plan, also of trials that are left out.
        by: the measure of quality, of `QUALITIES`.
        length_unit: of the resolution, "mm" or "px".
        scan: facts for people, by name.
        stopped: it was interrupted before all trials were done.
        light: of a frame; None: the dose is counted in frames.
        notes: sentences on what the figures mean.
    """

    outcomes: tuple[Outcome, ...]
    by: str
    length_unit: str
    machine: Mapping[str, str | int]
    scan: Mapping[str, str]
    command: str
    stopped: bool = False
    light: Light | None = None
    notes: Sequence[str] = ()

    def with_outcome(self, index: int, outcome: Outcome) -> TrialTable:
        """The table with this outcome in place of the one of this number."""
        return replace(self, outcomes=(*self.outcomes[:index], outcome, *self.outcomes[index + 1 :]))

    @property
    def dose(self) -> TrialCost:
        """The dose as a cost. Each frame of the scan that several views share is counted once."""
        light, scale, axis, unit = self.light, 1.0, "dose: frames that were exposed", "frames"
        if light is not None and light.gray is None:
            scale, axis, unit = light.photons, "photons a pixel in the open beam", "photons"
        elif light is not None and light.gray is not None:
            scale, axis, unit = light.gray, f"dose in {light.material} (Gy)", "Gy"
        return TrialCost("dose", "dose", axis, scale, lambda outcome: float(outcome.trial.frames), unit)

    @property
    def compared(self) -> tuple[Outcome, ...]:
        """The trials that reconstructed the scan successfully."""
        return tuple(o for o in self.outcomes if o.status == "done")

    @property
    def todo(self) -> list[int]:
        """Numbers of the trials that are not left out."""
        return [n for n, outcome in enumerate(self.outcomes) if not outcome.trial.left_out]

    def front(self, cost: TrialCost) -> list[Outcome]:
        """The trials that no other one beats, by rising cost, and so by rising quality; of equal ones the first.

        A trial is beaten by one of at most its cost and at least its quality. Costs are compared to 1 %: smaller
        differences between two trials are chance. A trial that costs more is on the front where its gain is above
        `chance`.
        """
        kept: list[Outcome] = []
        known = [o for o in self.compared if math.isfinite(cost.of(o)) and math.isfinite(o.quality(self.by))]
        for each in sorted(known, key=lambda o: (rounded(cost.of(o)), -o.quality(self.by))):
            if not kept or each.quality(self.by) - kept[-1].quality(self.by) > self.chance(each, kept[-1]):
                kept.append(each)
        return kept

    def chance(self, one: Outcome, other: Outcome) -> float:
        """dB between two trials that chance may reach.

        Without a truth: two standard errors of the mean difference of squared residuals over the views held out. The
        noise of a view is in both of its residuals, and so not in their difference.
        """
        first, second = (np.asarray(each.squared_residuals) for each in (one, other))
        if self.by != HELD_OUT or min(first.size, second.size) < 2 or first.size != second.size:
            return LEAST_GAIN
        apart, level = first - second, (first.mean() + second.mean()) / 2
        error = apart.std(ddof=1) / math.sqrt(apart.size)
        return max(LEAST_GAIN, _ERRORS * 10 / math.log(10) * float(error / level)) if level > 0 else LEAST_GAIN


def rounded(cost: float) -> float:
    """The cost rounded to steps of 1 %, so that smaller differences count as equal."""
    if not cost > 0 or math.isinf(cost):
        return cost
    step = math.log(1.01)
    return math.exp(round(math.log(cost) / step) * step)
