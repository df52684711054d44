"""Trial: one reconstruction to make, of which views, how and how long, and what became of it; pure values."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

from beamline.core.text import count
from beamline.features.trials.view_choices import ViewChoice
from recon.base.method import Method, Plain
from recon.methods import build, by_name, has_setting

Status = Literal["done", "failed", "out of time", "interrupted", "not run"]

_NAMES = ("materials", "states")  # settings that are several names
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
    def several(self) -> bool:
        """Its method makes several volumes; each view shows one of them, or a mixture."""
        return by_name(self.method).traits.several

    @property
    def left_out(self) -> bool:
        """The scan has not the views that it asks for."""
        return self.choice is not None and self.choice.groups is None

    @property
    def frames(self) -> int:
        """Frames of the scan that it takes, each counted once: its dose."""
        return self.views if self.choice is None else self.choice.frames

    @property
    def window(self) -> int:
        """Views of the scan that are averaged into each of its views."""
        return 1 if self.choice is None else self.choice.window

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
        return ", ".join([self.method, *parts, *(self._settings_in_words if self.several else [])])

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
    "gaussians": lambda n: thousands(n) if isinstance(n, int) else f"gaussians {n}",
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

    def quality(self, by: str) -> float:
        """dB by a metric in `QUALITIES`; NaN where it is not known."""
        return QUALITIES[by].decibels(self.metrics.get(by, math.nan))

    def as_record(self) -> dict[str, Any]:
        """Plain values for a table or JSON."""
        return {f.name: getattr(self, f.name) for f in fields(self)} | {"trial": self.trial.as_record()}


@dataclass(frozen=True)
class Quality:
    """A metric that trials are compared by, in dB; more is better.

    Attributes:
        words: in sentences.
        axis: label in pictures.
        decibels: of a value of the metric; NaN where there are none.
        of_views: views held out are measured, each for itself.
    """

    words: str
    axis: str
    decibels: Callable[[float], float]
    of_views: bool = False


QUALITIES: Mapping[str, Quality] = {
    "psnr": Quality("PSNR", "PSNR (dB)", lambda value: value),
    "psnr_all": Quality("PSNR", "PSNR (dB)", lambda value: value),
    "residual_held_out": Quality(
        "−20 log₁₀ of the held-out residual",
        "held-out residual (dB below the data)",
        lambda value: -20 * math.log10(value) if value > 0 else math.nan,
        of_views=True,
    ),
}
"""By the name of the metric."""


def thousands(n: int) -> str:
    """A number of Gaussians in words, in thousands from 1000 on."""
    return f"{n / 1000:.3g}k Gaussians" if n >= 1000 else f"{n} Gaussians"
