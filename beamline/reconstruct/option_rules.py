"""Rules of a reconstruction's options: whose they are, what they do not go with, what they need.

They hold on the command line, in a recipe and in Python, with the same sentence. An option is named by its long name,
without dashes. This module loads nothing that computes, so that help is quick.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from recon.base.choices import AUTO


@dataclass(frozen=True)
class OptionRule:
    """The methods or the value that an option belongs to, and what it excludes or requires.

    Attributes:
        setting: of the methods with this setting, by its path in Python, such as `fit.loss`.
        trait: of the methods with this trait, where the option is no setting of theirs.
        inverted: it is a flag that switches the setting off.
        value: of `ReconOptions`, by its path, that it gives.
        excludes: what does not go with it, and why.
        needs: another option, without which this one means nothing, and the end of the sentence that says so.
    """

    setting: str = ""
    trait: str = ""
    inverted: bool = False
    value: str = ""
    excludes: Mapping[str, str] = field(default_factory=dict)
    needs: tuple[str, str] | None = None

    @property
    def of_methods(self) -> bool:
        """Whether only some methods have the option."""
        return bool(self.setting or self.trait)


SLABS_RESUMED = "resume of slabs"
"""Stands for `--resume` of a partial volume, which has rules of its own."""
OF_ONE_VOLUME = {
    "roi": "a box is of one volume",
    "truth": "a truth is compared with one volume",
    "uncertainty": "error bars are of one volume",
    **dict.fromkeys(("cluster", SLABS_RESUMED), "several volumes are not made in slabs"),
}
"""Options that several volumes, in time or of materials, do not go with."""

_FINISHED = {"follow": "it is for a finished scan"}
_BY_BUDGET = {"budget": "--budget chooses it"}
_NOT_KEPT = {"budget": "a run within a budget keeps no checkpoints", **_FINISHED}
_PLANNED = {**_BY_BUDGET, "quality": "--quality chooses it"}
_BY_SECONDS = {"follow": "it is for a finished scan; give --seconds"}
_RUNNING = ("follow", "is for a scan that still runs: give --follow.")
_IN_MEMORY = dict.fromkeys(("follow", "budget"), "such a run holds everything in memory")
_FOR_TIME = dict.fromkeys(("follow", "budget", "seconds"), "error bars need the whole scan, and time for refits")

RULES: Mapping[str, OptionRule] = {
    "steps": OptionRule("steps", excludes={"seconds": "give one of them", **_PLANNED}),
    "seconds": OptionRule("seconds", excludes=_PLANNED),
    "budget": OptionRule(trait="budget", value="budget", excludes={"quality": "give one of them", **_BY_SECONDS}),
    "quality": OptionRule(trait="presets", value="quality", excludes=_BY_SECONDS),
    "gaussians": OptionRule("gaussians", excludes=_PLANNED),
    "start": OptionRule("start", excludes={**_BY_BUDGET, **_FINISHED}),
    "loss": OptionRule("fit.loss", excludes=_BY_BUDGET),
    "kernel": OptionRule("fit.kernel", excludes=_BY_BUDGET),
    "device": OptionRule(trait="device", value="device", excludes={**_BY_BUDGET, **_FINISHED}),
    "early-stop": OptionRule("early_stop", excludes={**_BY_BUDGET, **_FINISHED}),
    "finish": OptionRule("finish", excludes={**_PLANNED, **_FINISHED}),
    "checkpoint": OptionRule(trait="checkpoints", value="checkpoints.path", excludes=_NOT_KEPT),
    "resume": OptionRule(trait="checkpoints", value="checkpoints.resume", excludes=_NOT_KEPT),
    "iterations": OptionRule("iterations", excludes=_BY_BUDGET),
    "tv-weight": OptionRule("tv_weight"),
    "patch-threshold": OptionRule("patch_threshold"),
    "allow-negative": OptionRule("allow_negative", excludes=_FINISHED),
    "time": OptionRule(
        "volumes",
        excludes={**_FINISHED, **OF_ONE_VOLUME},
    ),
    "moves": OptionRule("moves", needs=("time", "is of volumes in time: give --time N with it.")),
    "plain-splatting": OptionRule("fit.rays.rectified", inverted=True, excludes=_BY_BUDGET),
    "uncertainty": OptionRule(value="uncertainty", excludes=_FOR_TIME),
    "truth": OptionRule(value="truth"),
    "follow": OptionRule(
        value="follow",
        excludes={
            SLABS_RESUMED: "these slabs are of a finished scan",
        },
    ),
    "earlier": OptionRule(needs=("follow", "is for a run that goes on: give --follow, or the joined.h5 of its parts.")),
    "enough-loss": OptionRule(value="enough.psnr_loss", needs=_RUNNING),
    "enough-gain": OptionRule(value="enough.psnr_gain_per_10_views", needs=_RUNNING),
    "unfinished": OptionRule(value="unfinished"),
    "memory": OptionRule(value="memory", excludes=_IN_MEMORY),
    "cluster": OptionRule(value="cluster", excludes=_IN_MEMORY),
    "roi": OptionRule(
        value="region",
        excludes={
            "follow": "it is for a finished scan",
            "truth": "a truth is compared with the whole volume",
        },
    ),
    "dry-run": OptionRule(
        excludes={"follow": "a scan that runs takes its own time", "budget": "a budget sets the time"}
    ),
    SLABS_RESUMED: OptionRule(value="partial"),
}
"""By the option's name, in the order in which they are looked at."""


def takers(rule: OptionRule) -> tuple[str, ...]:
    """Names of the methods that have an option."""
    from recon.methods import taking, with_trait  # here: not every command needs methods

    if rule.setting:
        return taking(rule.setting)
    from recon.auto import Auto  # here, because it loads all methods

    return (*((AUTO,) if getattr(Auto.traits, rule.trait) else ()), *with_trait(rule.trait))


def _has_setting(method: str, rule: OptionRule) -> bool:
    """Whether a method is known to take an option of methods, without a look at the others, which load torch."""
    from recon.methods import METHODS, by_name, has_setting

    return bool(rule.setting) and method in METHODS and has_setting(by_name(method), rule.setting)


def contradiction(
    rules: Mapping[str, OptionRule],
    given: Collection[str],
    shown: Mapping[str, str] = MappingProxyType({}),
    *,
    one_method: bool = False,
) -> str:
    """Why options contradict each other, or which required option is missing; "" if they agree.

    Args:
        rules: of all options, by name.
        given: names of the options that somebody gave.
        shown: what the sentence calls some of them; the others by their names.
        one_method: settings are of a method that was made with all of them, and says itself what they mean together.
    """
    for name in (name for name in rules if name in given):
        text = shown.get(name, f"--{name}")
        for other, why in rules[name].excludes.items():
            both_settings = rules[name].setting and other in rules and rules[other].setting
            if other in given and not (one_method and both_settings):
                return f"{text} does not go with {shown.get(other, f'--{other}')}: {why}. Nothing was computed."
        needs = rules[name].needs
        if needs is not None and needs[0] not in given:
            return f"{text} {needs[1]}"
    return ""


def of_other_methods(
    rules: Mapping[str, OptionRule], given: Collection[str], method: str, *, stated: bool = True
) -> str:
    """Which given option belongs to other methods than this one; "" if none does.

    Args:
        stated: somebody chose the method; else it is the default.
    """
    asked = {name: rule for name, rule in rules.items() if name in given and rule.of_methods}
    if all(_has_setting(method, rule) for rule in asked.values()):
        return ""
    owners = {name: takers(rule) for name, rule in asked.items()}
    for name, methods in owners.items():
        if method in methods:
            continue
        what = f"it does not go with --method {method}." if stated else "give --method with one of these."
        for other in () if stated else owners:
            if not set(owners[other]) & set(methods):
                what = f"--{other} is of {', '.join(owners[other])}. Give one of the two options."
        return f"--{name} is of {', '.join(methods)}; {what}"
    return ""
