"""Options of reconstruction methods, and which of them go together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import click
from click.core import ParameterSource

from beamline.cli.options import POSITIVE
from recon.assess.time_model import PRESETS, parse_budget
from recon.base.method import Method
from recon.methods import build, by_name, has_setting, taking, with_trait
from recon.splatting.initialise import Start
from recon.splatting.problem import Loss
from recon.splatting.r2 import DEFAULT_STEPS

SETTINGS = {
    "steps": "steps", "seconds": "seconds", "gaussians": "gaussians", "start": "start", "loss": "fit.loss",
    "early_stop": "early_stop", "polish": "polish", "iterations": "iterations", "tv_weight": "tv_weight",
}  # fmt: skip
"""Options that are settings of methods, and the name of each setting: a method that has it takes the option."""

_TRAITS = {
    "budget": "presets", "quality": "presets", "device": "device", "checkpoint": "checkpoints", "resume": "checkpoints",
}  # fmt: skip
"""Options for methods with a trait, and the trait."""

_PLANS = ("budget", "quality")
_TIMED = ("steps", "seconds", "gaussians")
_OF_A_FIT = (*_TIMED, "start", "loss", "device", "early_stop", "polish", "checkpoint", "resume")
# The options that exclude each of those that choose a plan.
_CHOSEN = {"budget": ("quality", *_OF_A_FIT), "quality": ("budget", *_TIMED, "polish")}
_FINISHED = tuple(name for name in _OF_A_FIT if name not in _TIMED)  # of scans that are finished only


def time_given(ctx: click.Context, param: click.Parameter, value: str | None) -> float | None:
    """A time such as 30s, 2m or 1h, in s."""
    if value is None:
        return None
    try:
        return parse_budget(value)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error


def checkpoint_output(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """A file name."""
    if value is not None and not value.name:
        raise click.BadParameter(f"{str(value)!r} is no file; name one, such as fit.checkpoint.h5")
    return value


def method_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options of the fit and of the iterative methods."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def method_with(name: str, options: Mapping[str, Any]) -> Method:
    """The method of this name, with those of the options that are settings of it.

    Args:
        name: in `recon.methods`.
        options: values by option; None stands for the method's own.
    """
    method = by_name(name)
    paths = {option: SETTINGS.get(option, option) for option, value in options.items() if value is not None}
    return build(method, {path: options[option] for option, path in paths.items() if has_setting(method, path)})


def takers(option: str) -> tuple[str, ...]:
    """Names of the methods that take an option."""
    return with_trait(_TRAITS[option]) if option in _TRAITS else taking(SETTINGS[option])


def _of(option: str) -> str:
    """Names of the methods that take an option, for its help."""
    return ", ".join(takers(option))


def refuse_contradictions(ctx: click.Context, method: str, follow: bool) -> None:
    """Raises UsageError for options that exclude each other, or are of another method.

    Args:
        ctx: of a command with `method_options`; only options that its user gave count.
        method: its name in `recon.methods`.
        follow: the scan is still running.
    """
    given = [name for name in (*_TRAITS, *SETTINGS) if ctx.get_parameter_source(name) != ParameterSource.DEFAULT]
    if {"steps", "seconds"} <= set(given):
        raise click.UsageError("--steps and --seconds exclude each other: say how long the fit may take in one way.")
    for plan in _PLANS:
        others = [name for name in given if name in _CHOSEN[plan]]
        if plan in given and others:
            raise click.UsageError(
                f"{_option(plan)} and {_option(others[0])} exclude each other: {_option(plan)} chooses what the other "
                "says, or leaves no room for it."
            )
        if plan in given and follow:
            raise click.UsageError(f"{_option(plan)} is for a finished scan; with --follow give --seconds.")
    for name in given:
        if method not in (owners := takers(name)):
            raise click.UsageError(f"{_option(name)} is of {', '.join(owners)}; it does not go with --method {method}.")
    endless = [name for name in given if follow and name in _FINISHED]
    if endless:
        raise click.UsageError(f"{_option(endless[0])} is for a finished scan; it does not go with --follow.")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


_OPTIONS = (
    click.option(
        "--steps", type=click.IntRange(min=1), help=f"Steps of the fit ({_of('steps')}). Default: {DEFAULT_STEPS}."
    ),
    click.option(
        "--seconds",
        type=POSITIVE,
        help=f"Time for the fit ({_of('seconds')}), instead of --steps; with --follow, after the scan has ended.",
    ),
    click.option(
        "--budget",
        callback=time_given,
        metavar="30s|2m|1h",
        help="Time from line integrals to volume; chooses method, Gaussians, steps and binning, and ends in time.",
    ),
    click.option(
        "--quality",
        type=click.Choice(list(PRESETS)),
        help="A preset of steps and Gaussians, instead of naming them.",
    ),
    click.option("--gaussians", type=click.IntRange(min=1), help=f"How many to start from ({_of('gaussians')})."),
    click.option(
        "--start",
        type=click.Choice(get_args(Start)),
        default="fbp",
        show_default=True,
        help=f"Volume that Gaussians are first drawn from ({_of('start')}); tv: slower, without streaks of few views.",
    ),
    click.option(
        "--loss",
        type=click.Choice(get_args(Loss)),
        default="l1",
        show_default=True,
        help=f"Misfit of the fit ({_of('loss')}), beside SSIM: absolute, squared, or squares weighed by photon noise.",
    ),
    click.option(
        "--device", default="cpu", show_default=True, metavar="cpu|cuda", help=f"Of the fit ({_of('device')})."
    ),
    click.option(
        "--early-stop",
        is_flag=True,
        help=f"End the fit ({_of('early_stop')}) when views held out no longer gain; every tenth is held out where "
        "--views leaves none.",
    ),
    click.option(
        "--polish",
        type=click.IntRange(min=0),
        default=0,
        show_default=True,
        help=f"Sweeps on voxels after the fit ({_of('polish')}), which sharpen edges: 3 gain 0.3 to 2 dB.",
    ),
    click.option(
        "--checkpoint",
        type=click.Path(path_type=Path, dir_okay=False),
        callback=checkpoint_output,
        help=f"Keep the fit's state here ({_of('checkpoint')}): every minute, when it ends, and at Ctrl-C.",
    ),
    click.option(
        "--resume",
        type=click.Path(path_type=Path, dir_okay=False),
        help=f"Go on from a checkpoint of the same data and options ({_of('resume')}).",
    ),
    click.option(
        "--iterations", type=click.IntRange(min=1), help="Of an iterative method. Default: each method's own."
    ),
    click.option(
        "--tv-weight",
        type=POSITIVE,
        help=f"Of the total variation ({_of('tv_weight')}), in units of the sample's density.",
    ),
)
