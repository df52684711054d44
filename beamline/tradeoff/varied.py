"""Varied: which settings of each method a trade-off tries, how much work a run is, and the colours of pictures.

A method without a line in `TRIALS` or `COLOURS` is tried with its defaults, in a colour that is left.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

from recon.base.kernel import Kernel
from recon.base.method import Method, Plain
from recon.methods import has_setting, names
from recon.splatting.fit_method import FitMethod
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings

Depth = Literal["quick", "full"]

_BASE_STEPS = {"quick": 250, "full": 1000}
_STEPS = {"quick": (60, 125, 250, 500), "full": (125, 250, 500, 1000, 2000)}
_FACTORS = {"quick": (0.25,), "full": (0.25, 0.5, 2.0)}
_PUBLISHED_STEPS = {"quick": (1000,), "full": (3000, 10_000)}
_FIELD_STEPS = {"quick": (300,), "full": (1000, 3000)}
_BINNED_STEPS = {"quick": (250,), "full": (125, 500, 1000)}
_ENDLESS = 10**6  # steps or iterations: a time ends the run long before


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
    return TRIALS.get(method, _baseline)(gaussians, depth)


def ended_by_time(method: type[Method], seconds: float) -> dict[str, Plain]:
    """The settings with which so many seconds, and nothing else, end a run of the method; see `Traits.own_length`."""
    if method.traits.own_length:
        return {}
    lengths: dict[str, Plain] = {"seconds": seconds, "steps": _ENDLESS, "iterations": _ENDLESS}
    return {name: value for name, value in lengths.items() if has_setting(method, name)}


def work_of(method: Method, n_views: int, binning: int) -> float:
    """A rough measure of the time that a run takes, to be compared within one method only."""
    if isinstance(method, FitMethod):
        count = method.gaussians.n if isinstance(method.gaussians, Gaussians) else method.gaussians or 0
        spread = method.fit.kernel.reach(method.fit.truncation.sigmas) / FitSettings().kernel.radius
        return (method.planned_steps or 0) * (1 + count / 2e4 * spread**2)
    return n_views * (getattr(method, "iterations", None) or 1) / binning**3


def colour_of(method: str) -> str:
    """Of a method in pictures, as matplotlib takes it."""
    others = [name for name in names() if name not in COLOURS]
    return COLOURS[method] if method in COLOURS else _SPARE[others.index(method) % len(_SPARE)]


def _baseline(gaussians: int, depth: Depth) -> list[TrialSettings]:
    return [TrialSettings("method")]


def _iterations(quick: Sequence[int], full: Sequence[int], gaussians: int, depth: Depth) -> list[TrialSettings]:
    """Numbers of iterations: the middle one is the baseline."""
    numbers = {"quick": quick, "full": full}[depth]
    base = numbers[len(numbers) // 2]
    others = [TrialSettings("iterations", {"iterations": n}) for n in numbers if n != base]
    return [TrialSettings("method", {"iterations": base}), *others]


def _beside_chosen(quick: Sequence[int], full: Sequence[int], gaussians: int, depth: Depth) -> list[TrialSettings]:
    """Numbers of iterations beside the one that the data choose, the baseline."""
    numbers = {"quick": quick, "full": full}[depth]
    return [TrialSettings("method"), *(TrialSettings("iterations", {"iterations": n}) for n in numbers)]


def _fits(gaussians: int, depth: Depth) -> list[TrialSettings]:
    base: dict[str, Plain] = {"steps": _BASE_STEPS[depth], "gaussians": gaussians}
    found = [TrialSettings("method", base)]
    found += [TrialSettings("steps", base | {"steps": n}) for n in _STEPS[depth] if n != base["steps"]]
    counts = [max(1, round(factor * gaussians)) for factor in _FACTORS[depth]]
    found += [TrialSettings("gaussians", base | {"gaussians": count}) for count in counts]
    # A bin of two halves the detail across: a quarter of the Gaussians describes it.
    coarse = max(1, gaussians // 4)
    found += [
        TrialSettings("binning", {"steps": steps, "gaussians": coarse}, binning=2) for steps in _BINNED_STEPS[depth]
    ]
    others = [kernel.value for kernel in Kernel if kernel is not FitSettings().kernel]
    found += [TrialSettings("kernel", base | {"fit.kernel": name}) for name in others]
    found.append(TrialSettings("start", base | {"start": "tv"}))
    found.append(TrialSettings("loss", base | {"fit.ssim_weight": 0.0}))
    found += [TrialSettings("loss", base | {"fit.loss": loss}) for loss in ("l2", "poisson")]
    found.append(TrialSettings("rectification", base | {"fit.rays.rectified": False}))
    return found


def _fields(gaussians: int, depth: Depth) -> list[TrialSettings]:
    base, *longer = ({"steps": steps} for steps in _FIELD_STEPS[depth])
    return [TrialSettings("method", base), *(TrialSettings("steps", one) for one in longer)]


def _published(gaussians: int, depth: Depth) -> list[TrialSettings]:
    """The published fit in fewer than its 30 000 steps, which would take a trade-off hours."""
    base, *longer = ({"steps": steps, "gaussians": gaussians} for steps in _PUBLISHED_STEPS[depth])
    return [TrialSettings("method", base), *(TrialSettings("steps", one) for one in longer)]


TRIALS: Mapping[str, Callable[[int, Depth], list[TrialSettings]]] = {
    "r2": _fits,
    "r2-published": _published,
    **dict.fromkeys(("naf", "intratomo", "sax-nerf"), _fields),
    "sirt": partial(_iterations, (20, 60), (10, 30, 100, 300)),
    "sart": partial(_iterations, (2, 6), (1, 3, 10, 30)),
    "osem": partial(_beside_chosen, (3, 12), (1, 3, 6, 12, 50)),
    "mlem": partial(_beside_chosen, (12, 50), (4, 12, 24, 50, 200)),
    "cgls": partial(_iterations, (5, 15), (5, 10, 20, 40)),
    "asd-pocs": partial(_iterations, (10,), (5, 20, 50)),
    "fista-tv": partial(_iterations, (5, 20), (5, 10, 20, 40)),
    "os-sirt-tv": partial(_iterations, (5, 15), (5, 10, 20, 40)),
    "pnp-dct": partial(_iterations, (35,), (15, 35, 70)),
}

MOTION: Mapping[str, tuple[bool | None, int]] = {"none": (False, 2), "learnt": (True, 3), "chosen": (None, 5)}
"""Of a series: the argument of `recon.fit_series`, and its work. Views held out choose in a trial of each."""

JOINT: Mapping[str, Callable[[Mapping[str, Plain]], float]] = {
    "series": lambda settings: float(settings["volumes"] or 0) * MOTION[str(settings["motion"])][1],
    "materials": lambda settings: 1.0 + ("share" in settings),
}
"""Fits of all volumes in time, or of all materials, that are no method of `recon.methods`: their work a view."""

COLOURS: Mapping[str, str] = {
    "r2": "tab:blue", "r2-published": "navy", "fbp": "0.35", "sirt": "tab:green", "sart": "tab:olive",
    "cgls": "tab:cyan", "asd-pocs": "tab:purple", "fista-tv": "tab:red", "os-sirt-tv": "tab:orange",
    "pnp-dct": "maroon",
    "osem": "gold", "mlem": "teal", "naf": "tab:brown", "intratomo": "rosybrown", "sax-nerf": "darkviolet",
    "series": "darkgreen", "materials": "darkgreen",
}  # fmt: skip
_SPARE = ("tab:pink", "black")
