"""Options of reconstruction methods, and their allowed combinations."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import click
from click.core import ParameterSource

from beamline.cli.option_groups import METHOD, OUTPUT, RESOURCES, heading
from beamline.cli.options import POSITIVE, parsed, together
from beamline.core.errors import DataError
from recon.assess.plans import PRESETS
from recon.assess.time_model import parse_budget
from recon.base.choices import AUTO, DEFAULT_STEPS, KERNEL, MODEL_STEPS, Loss, Start
from recon.base.kernel import Kernel
from recon.base.method import Method, Plain
from recon.methods import DEFAULT, build, by_name, has_setting, names, taking, with_trait

SETTINGS = {
    "steps": "steps", "seconds": "seconds", "gaussians": "gaussians", "start": "start", "loss": "fit.loss",
    "kernel": "fit.kernel", "early_stop": "early_stop", "finish": "finish", "iterations": "iterations",
    "tv_weight": "tv_weight", "patch_threshold": "patch_threshold", "allow_negative": "allow_negative",
    "plain_splatting": "fit.rays.rectified",
}  # fmt: skip
"""Options that are settings of methods, and the name of each setting: a method that has it takes the option."""

_TRAITS = {
    "budget": "budget", "quality": "presets", "device": "device", "checkpoint": "checkpoints", "resume": "checkpoints",
}  # fmt: skip
"""Options for methods with a trait, and the trait."""

_INVERTED = ("plain_splatting",)  # flags that switch their setting off

PRESETS_OF_METHODS = ("published",)
"""Endings of names of methods that are variants of another method, such as r2-published."""

_ROW_SETTINGS = ("steps", "gaussians", "finish", "iterations", "tv_weight", "patch_threshold")
_PLANS = ("budget", "quality")
_TIMED = ("steps", "seconds", "gaussians")
_OF_A_FIT = (
    *_TIMED,
    "start",
    "loss",
    "kernel",
    "plain_splatting",
    "device",
    "early_stop",
    "finish",
    "checkpoint",
    "resume",
)
# For each option that chooses a plan: the options that it excludes.
_CHOSEN = {"budget": ("quality", *_OF_A_FIT, "iterations"), "quality": ("budget", *_TIMED, "finish")}
_STREAMED = (*_TIMED, "loss", "kernel", "plain_splatting")
_FINISHED = (*(name for name in _OF_A_FIT if name not in _STREAMED), "allow_negative")  # of finished scans only


def checkpoint_output(path: Path) -> Path:
    """The path, which names a file. ValueError for another."""
    if not path.name:
        raise ValueError(f"{str(path)!r} is no file; name one, such as fit.checkpoint.h5")
    return path


def row_settings(methods: Sequence[str], options: dict[str, Any]) -> dict[str, dict[str, Plain]]:
    """Settings by method, of the options of `row_options` that were given; takes all of these out of `options`.

    Raises:
        UsageError: an option that no method takes.
    """
    given = {name: value for name in _ROW_SETTINGS if (value := options.pop(name)) is not None}
    for name in given:
        if not set(methods) & set(owners := takers(name)):
            raise click.UsageError(f"{_option(name)} is of {', '.join(owners)}; no row is by one of these.")
    return {
        method: {SETTINGS[name]: value for name, value in given.items() if method in takers(name)} for method in methods
    }


def method_with(name: str, options: Mapping[str, Any]) -> Method:
    """The method of this name, with the given options that are settings of it.

    Args:
        name: in `recon.methods`, or of `recon.Auto`.
        options: values by option; None stands for the method's own.
    """
    if name == AUTO:
        from recon.auto import Auto  # here, because it loads all methods

        return Auto(tuple(method_with(method.name, options) for method in Auto().candidates))
    method = by_name(name)
    any_setting = options.get("any_setting") or {}
    options = {option: value for option, value in options.items() if option != "any_setting"}
    paths = {option: SETTINGS.get(option, option) for option, value in options.items() if value is not None}
    values = {path: not options[o] if o in _INVERTED else options[o] for o, path in paths.items()}
    known = {path: value for path, value in values.items() if has_setting(method, path)}
    try:
        return build(method, known | {path: _of_kind(method, path, value) for path, value in any_setting.items()})
    except (ValueError, TypeError) as error:
        raise click.UsageError(f"--set: {error}. Nothing was computed.") from error


def settings_given(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> dict[str, Any]:
    """NAME=VALUE, several in one text apart by spaces, as a value by name: JSON, or else text."""
    found: dict[str, Any] = {}
    for word in " ".join(values).split():
        name, equals, text = word.partition("=")
        if not (name and equals and text):
            raise click.BadParameter(f"{word!r} is no setting; expected NAME=VALUE, such as fit.decay=0.1")
        try:
            found[name] = json.loads(text)
        except ValueError:
            found[name] = text
    return found


def preset_of(method: str | None, preset: str | None) -> str | None:
    """The name of the method with a preset's settings; the method itself without one.

    Raises:
        UsageError: the method has no such preset.
    """
    if preset is None:
        return method
    name = f"{method or DEFAULT}-{preset}"
    if name not in names():
        raise click.UsageError(f"--preset {preset} is of {DEFAULT}; it does not go with --method {method}.")
    return name


def _of_kind(method: type[Method], path: str, value: Any) -> Any:
    """The value of a setting, if it has the kind of the method's default; None leaves the choice to the method."""
    if not has_setting(method, path):
        return value  # `build` names the methods that have the setting
    own: Any = method()
    for name in path.split("."):
        own = getattr(own, name)
    if isinstance(own, tuple) and isinstance(value, list):
        return tuple(value)
    numbers, given = isinstance(own, int | float), isinstance(value, int | float)
    fits = isinstance(own, bool) == isinstance(value, bool) and numbers == given
    if own is not None and (
        not fits or dataclasses.is_dataclass(own) or isinstance(own, str) != isinstance(value, str)
    ):
        raise ValueError(f"{path}={value!r} is not of the kind of {own!r}, the default")
    return value


def options_of_a_method(ctx: click.Context) -> list[str]:
    """The options of methods that the user gave; any method resumes a partial volume."""
    given = [name for name in (*_TRAITS, *SETTINGS) if ctx.get_parameter_source(name) != ParameterSource.DEFAULT]
    return [name for name in given if name != "resume" or not resumes_slabs(ctx.params["resume"])]


def resumes_slabs(path: Path | None) -> bool:
    """Whether the file of --resume is a partial volume."""
    from beamline.storage.writers.partial_volume import is_partial  # here: help does not need it

    return path is not None and is_partial(path)


def takers(option: str) -> tuple[str, ...]:
    """Names of the methods that take an option."""
    if option not in _TRAITS:
        return taking(SETTINGS[option])
    from recon.auto import Auto

    trait = _TRAITS[option]
    return (*((Auto.name,) if getattr(Auto.traits, trait) else ()), *with_trait(trait))


def refuse_contradictions(ctx: click.Context, method: str, follow: bool) -> None:
    """Raises UsageError for options that exclude each other, or are of another method.

    DataError if the file of --resume is missing.

    Args:
        ctx: of a command with `method_options`; only options that its user gave count.
        method: its name, as in `method_with`.
        follow: the scan is still running.
    """
    given = options_of_a_method(ctx)
    if {"steps", "seconds"} <= set(given):
        raise click.UsageError("--steps and --seconds exclude each other. Give one of them.")
    for plan in _PLANS:
        others = [name for name in given if name in _CHOSEN[plan]]
        if plan in given and others:
            raise click.UsageError(
                f"{_option(plan)} and {_option(others[0])} exclude each other: {_option(plan)} determines "
                f"what {_option(others[0])} would set."
            )
        if plan in given and follow:
            raise click.UsageError(f"{_option(plan)} is for a finished scan; with --follow give --seconds.")
    for name in given:
        if method not in (owners := takers(name)):
            if name == "resume" and not ctx.params[name].exists():
                raise DataError(f"--resume {ctx.params[name]} is not there. Nothing was touched.")
            raise click.UsageError(f"{_option(name)} is of {', '.join(owners)}; it does not go with --method {method}.")
    endless = [name for name in given if follow and name in _FINISHED]
    if endless:
        raise click.UsageError(f"{_option(endless[0])} is for a finished scan; it does not go with --follow.")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


preset_option = click.option(
    "--preset",
    type=click.Choice(PRESETS_OF_METHODS),
    help="published: R²-Gaussian with all settings as published (Zha et al. 2024): 30 000 steps, no finish. "
    "The same as the method r2-published.",
)
_STEPS = click.option(
    "--steps",
    type=click.IntRange(min=1),
    help=f"Steps of the fit of Gaussians. Default: {DEFAULT_STEPS}; "
    f"{MODEL_STEPS} where views held out say that voxels alone predict as well.",
)
_GAUSSIANS = click.option("--gaussians", type=click.IntRange(min=1), help="Number of Gaussians at the start.")
_FINISH = click.option(
    "--finish",
    type=click.IntRange(min=0),
    help="Sweeps on voxels after the fit, which bring back edges, cracks and pores. Default: 8, "
    "or 16 or 24 where views held out are explained the better; 0: none.",
)
_ITERATIONS = click.option(
    "--iterations",
    type=click.IntRange(min=1),
    help="Iterations of an iterative method. Default: depends on the method.",
)
_TV_WEIGHT = click.option(
    "--tv-weight", type=POSITIVE, help="Weight of the total variation, relative to the density of the sample."
)
_PATCH_THRESHOLD = click.option(
    "--patch-threshold",
    type=POSITIVE,
    help="Cosine coefficients of patches up to this threshold are set to 0, relative to the density of the sample. "
    "Default: as views held out prefer.",
)
_ALLOW_NEGATIVE = click.option(
    "--allow-negative",
    is_flag=True,
    help="Keep voxels below zero, also in the sweeps after a fit: where air is not at zero, weak matter is not clipped "
    "with it.",
)
row_options = together(heading(METHOD), _STEPS, _GAUSSIANS, _FINISH, _ITERATIONS, _TV_WEIGHT, _PATCH_THRESHOLD)
"""The options of methods for every row of a table: length and start of the work."""
equal_time = click.option(
    "--seconds",
    type=POSITIVE,
    metavar="EACH",
    help="Compare in equal time: each reconstruction ends when so many seconds are over. Direct methods take what they "
    "take.",
)
"""The time of every row of a table."""
method_options = together(
    heading(METHOD),
    _STEPS,
    click.option(
        "--seconds",
        type=POSITIVE,
        help="Time of the whole call, from reading the scan to volume and report, instead of --steps. If it is too "
        "little, a warning says so before the fit. With --follow: of the fit after the end of the scan.",
    ),
    click.option(
        "--budget",
        callback=parsed(parse_budget),
        metavar="30s|2m|1h",
        help="Time from line integrals to volume: chooses method, steps, Gaussians and binning to end in time.",
    ),
    click.option("--quality", type=click.Choice(list(PRESETS)), help="Preset of steps and Gaussians."),
    _GAUSSIANS,
    click.option(
        "--start",
        type=click.Choice(get_args(Start)),
        help="Volume that the first Gaussians are drawn from; tv: slower, no streaks of few views; published: with the "
        "plain ramp, drawn and weighted as published. Default: fbp; published by r2-published.",
    ),
    click.option(
        "--loss",
        type=click.Choice(get_args(Loss)),
        help="Loss of the fit, beside SSIM: absolute, squared, or squares weighted by photon noise. Default: l1.",
    ),
    click.option(
        "--kernel",
        type=click.Choice([kernel.value for kernel in Kernel]),
        help="Shape of the Gaussians: true ones, or with an end of their own, (1 - r²/8)^1.5. "
        f"Default: {KERNEL}; gaussian by r2-published.",
    ),
    heading(RESOURCES),
    click.option("--device", default="cpu", show_default=True, metavar="cpu|cuda", help="Device of the fit."),
    heading(METHOD),
    click.option(
        "--early-stop",
        is_flag=True,
        help="End the fit when views held out stop improving; holds out every tenth if --views leaves none.",
    ),
    _FINISH,
    heading(OUTPUT),
    click.option(
        "--checkpoint",
        type=click.Path(path_type=Path, dir_okay=False),
        callback=parsed(checkpoint_output),
        help="Write the state of the fit to this file: every minute, at the end, and at Ctrl-C.",
    ),
    click.option(
        "--resume",
        type=click.Path(path_type=Path, dir_okay=False),
        help="Continue the fit from this checkpoint, or make the slabs that this partial volume lacks: with the same "
        "data and options.",
    ),
    heading(METHOD),
    _ITERATIONS,
    _TV_WEIGHT,
    _PATCH_THRESHOLD,
    _ALLOW_NEGATIVE,
    click.option(
        "--plain-splatting",
        is_flag=True,
        help="The uncorrected projection of 3DGS: one length for all rays in a Gaussian. It shows the bias that the "
        "corrected projection does not have.",
    ),
    click.option(
        "--set",
        "any_setting",
        multiple=True,
        metavar="NAME=VALUE",
        callback=settings_given,
        help="Any setting of the method by its name in Python, such as fit.decay=0.1 or fit.policy.every=50. "
        "May be repeated.",
    ),
)
"""The options of the fit and of the iterative methods."""
