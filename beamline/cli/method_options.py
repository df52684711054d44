"""Options of reconstruction methods, and their allowed combinations."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import click

from beamline.cli.options import (
    POSITIVE,
    NameChoice,
    WholeRange,
    declared,
    option,
    parsed,
    rules_of,
    run_option,
    together,
)
from beamline.cli.recipe import METHOD, OUTPUT, RESOURCES, heading
from beamline.core.errors import DataError
from recon.assess.time_model import MODEL_STEPS, PRESETS, parse_budget
from recon.base.choices import AUTO, KERNEL, Loss, Start
from recon.base.empirical import DEFAULT_STEPS
from recon.base.kernel import Kernel
from recon.base.method import Method, Plain
from recon.methods import DEFAULT, build, by_name, has_setting, names, taking

PRESETS_OF_METHODS = ("published",)
"""Endings of names of methods that are variants of another method, such as r2-published."""


def checkpoint_output(path: Path) -> Path:
    """The path of a checkpoint to write. Raises ValueError for a path without a file name."""
    if not path.name:
        raise ValueError(f"{str(path)!r} is no file; name one, such as fit.checkpoint.h5")
    return path


def checkpoint_input(ctx: click.Context, param: click.Parameter, path: Path | None) -> Path | None:
    """A callback that checks a checkpoint to read. Raises DataError if the file does not exist."""
    if path is not None and not path.exists():
        raise DataError(f"--{param.name} {path} does not exist. Nothing was changed.")
    return path


def settings_of(command: click.Command, values: dict[str, Any]) -> dict[str, Any]:
    """Settings of methods by path, removed from the parameter values of a command."""
    taken = [(param.rule, values.pop(name)) for name, param in declared(command).items() if param.rule.setting]
    return {rule.setting: not value if rule.inverted else value for rule, value in taken if value is not None}


def row_settings(command: click.Command, methods: Sequence[str], values: dict[str, Any]) -> dict[str, dict[str, Plain]]:
    """Settings by method, from the given options of `row_options`; removes these options from `values`.

    Raises:
        UsageError: an option that no method takes.
    """
    options = {rule.setting: name for name, rule in rules_of(command).items() if rule.setting}
    settings = settings_of(command, values)
    for path in settings:
        if not set(methods) & set(owners := taking(path)):
            raise click.UsageError(f"--{options[path]} is of {', '.join(owners)}; no row is by one of these.")
    return {method: {path: value for path, value in settings.items() if method in taking(path)} for method in methods}


def method_with(name: str, settings: Mapping[str, Any], any_setting: Mapping[str, Any] | None = None) -> Method:
    """The method of this name with its settings; settings of other methods are ignored.

    Args:
        name: in `recon.methods`, or of `recon.Auto`.
        settings: values by path.
        any_setting: values by path, as `--set` gives them; the method must have every one of these settings.
    """
    if name == AUTO:
        from recon.auto import Auto  # here, because it loads all methods

        return Auto(tuple(method_with(each.name, settings, any_setting) for each in Auto().candidates))
    method = by_name(name)
    its_own = {path: value for path, value in settings.items() if has_setting(method, path)}
    further = {path: tuple(value) if isinstance(value, list) else value for path, value in (any_setting or {}).items()}
    try:
        return build(method, its_own | further)
    except (ValueError, TypeError) as error:
        raise click.UsageError(f"--set: {error}. Nothing was computed.") from error


def settings_given(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> dict[str, Any]:
    """Parse settings by name from texts of NAME=VALUE separated by spaces; values are JSON, or else plain text."""
    settings: dict[str, Any] = {}
    for word in " ".join(values).split():
        name, equals, text = word.partition("=")
        if not (name and equals and text):
            raise click.BadParameter(f"{word!r} is no setting; expected NAME=VALUE, such as fit.decay=0.1")
        try:
            settings[name] = json.loads(text)
        except ValueError:
            settings[name] = text
    return settings


def preset_of(method: str | None, preset: str | None) -> str | None:
    """The method of this name with a preset's settings; without a preset, with its defaults.

    Raises:
        UsageError: the method has no such preset.
    """
    if preset is None:
        return method
    name = f"{method or DEFAULT}-{preset}"
    if name not in names():
        raise click.UsageError(f"--preset {preset} is of {DEFAULT}; it does not go with --method {method}.")
    return name


def slabs_resumed(path: Path | None) -> Path | None:
    """The file of --resume if it is a partial volume; else None."""
    from beamline.storage.writers.partial_volume import is_partial  # here: help does not need it

    return path if path is not None and is_partial(path) else None


preset_option = option(
    "--preset",
    of_one_call=True,  # it is in the name of the method
    type=NameChoice(PRESETS_OF_METHODS),
    help="published: R²-Gaussian with all settings as published (Zha et al. 2024): 30 000 steps, no finish. "
    "The same as the method r2-published.",
)
_STEPS = run_option(
    "--steps",
    type=WholeRange(min=1),
    help=f"Steps of the fit of Gaussians. Default: {DEFAULT_STEPS}; "
    f"{MODEL_STEPS} where voxels alone predict held-out views as well.",
)
_GAUSSIANS = run_option(
    "--gaussians",
    type=WholeRange(min=1),
    help="Number of Gaussians at the start.",
)
_FINISH = run_option(
    "--finish",
    type=WholeRange(min=0),
    help="Sweeps on voxels after the fit, which bring back edges, cracks and pores; 0: none. Default: 8, and steps "
    "with sparse patches where these predict held-out views better.",
)
_ITERATIONS = run_option(
    "--iterations",
    type=WholeRange(min=1),
    help="Iterations of an iterative method. Default: depends on the method.",
)
_TV_WEIGHT = run_option(
    "--tv-weight",
    type=POSITIVE,
    help="Weight of the total variation, relative to the density of the sample.",
)
_PATCH_THRESHOLD = run_option(
    "--patch-threshold",
    type=POSITIVE,
    help="Cosine coefficients of patches up to this threshold are set to 0, relative to the density of the sample. "
    "Default: chosen by held-out views.",
)
_ALLOW_NEGATIVE = run_option(
    "--allow-negative",
    is_flag=True,
    help="Keep voxels below zero, also in the sweeps after a fit: where air is not at zero, weak matter is not clipped "
    "with it.",
)
_IN_TIME = together(
    run_option(
        "--time",
        "volumes",
        type=WholeRange(min=2),
        metavar="N",
        help="For a sample that changes during the scan: N volumes at even times, in one .h5, from one fit of all "
        "views. Each needs twelve views or more.",
    ),
    run_option(
        "--moves/--no-moves",
        default=None,
        help="With --time: matter moves, or only its density changes. Default: chosen by held-out views.",
    ),
)
row_options = together(heading(METHOD), _STEPS, _GAUSSIANS, _FINISH, _ITERATIONS, _TV_WEIGHT, _PATCH_THRESHOLD)
"""The options of methods for every row of a table: length and start of the work."""
equal_time = option(
    "--seconds",
    excludes={
        "iterations": "give one of them",
        **dict.fromkeys(("time", "spectra"), "it is of methods that make one volume"),
    },
    type=POSITIVE,
    metavar="EACH",
    help="Compare in equal time: each reconstruction ends when so many seconds are over. Direct methods take what they "
    "take.",
)
"""The time of every row of a table."""
method_options = together(
    heading(METHOD),
    _STEPS,
    run_option(
        "--seconds",
        type=POSITIVE,
        help="Time of the whole call, instead of --steps: the fit gets what reading, correction, report and writing "
        "leave, which it does not shorten. If that is nothing, a warning says when the call will end. With --follow: "
        "most time after the end of the scan.",
    ),
    run_option(
        "--budget",
        callback=parsed(parse_budget),
        metavar="30s|2m|1h",
        help="Time from line integrals to volume: chooses method, steps, Gaussians and binning to end in time.",
    ),
    run_option(
        "--quality",
        type=NameChoice(list(PRESETS)),
        help="Preset of steps and Gaussians; of auto, of what is tried.",
    ),
    _GAUSSIANS,
    run_option(
        "--start",
        type=NameChoice(get_args(Start)),
        help="Volume that the first Gaussians are drawn from; tv: slower, no streaks of few views; published: with the "
        "plain ramp, drawn and weighted as published. Default: fbp; published by r2-published.",
    ),
    run_option(
        "--loss",
        type=NameChoice(get_args(Loss)),
        help="Loss of the fit, beside SSIM: absolute, squared, or squares weighted by photon noise. Default: l1.",
    ),
    run_option(
        "--kernel",
        type=NameChoice([kernel.value for kernel in Kernel]),
        help="Shape of the Gaussians: true ones, or with an end of their own, (1 - r²/8)^1.5. "
        f"Default: {KERNEL}; gaussian by r2-published.",
    ),
    heading(RESOURCES),
    run_option(
        "--device",
        default="cpu",
        show_default=True,
        metavar="cpu|cuda",
        help="Device that computes the fit, total variation and patches.",
    ),
    heading(METHOD),
    run_option(
        "--early-stop",
        is_flag=True,
        help="End the fit when held-out views stop improving; holds out every tenth unless --views does.",
    ),
    _FINISH,
    heading(OUTPUT),
    run_option(
        "--checkpoint",
        of_one_call=True,
        repeated=False,
        type=click.Path(path_type=Path, dir_okay=False),
        callback=parsed(checkpoint_output),
        help="Write the state of the fit to this file: every minute, at the end, and at Ctrl-C.",
    ),
    run_option(
        "--resume",
        of_one_call=True,
        callback=checkpoint_input,
        type=click.Path(path_type=Path, dir_okay=False),
        help="Continue the fit from this checkpoint, or make the slabs that this partial volume lacks: with the same "
        "data and options.",
    ),
    heading(METHOD),
    _ITERATIONS,
    _TV_WEIGHT,
    _PATCH_THRESHOLD,
    _ALLOW_NEGATIVE,
    _IN_TIME,
    run_option(
        "--plain-splatting",
        is_flag=True,
        help="The uncorrected projection of 3DGS: one length for all rays in a Gaussian. It has a bias that the "
        "corrected projection avoids.",
    ),
    option(
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
