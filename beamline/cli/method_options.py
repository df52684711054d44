"""Options of reconstruction methods, and their allowed combinations."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import click

from beamline.cli.options import POSITIVE, Declared, NameChoice, WholeRange, declared, option, parsed, together
from beamline.cli.recipe import METHOD, OUTPUT, RESOURCES, heading
from beamline.core.errors import DataError
from recon.assess.time_model import PRESETS, parse_budget
from recon.base.choices import AUTO, KERNEL, Loss, Start
from recon.base.empirical import DEFAULT_STEPS
from recon.base.kernel import Kernel
from recon.base.method import Method, Plain
from recon.methods import METHODS, accepting, build, by_name, has_setting, taking


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


def levels_of(given: str | Sequence[float]) -> tuple[float, ...]:
    """Densities from text such as "0.1,0.5", or from a recipe's list. Raises ValueError for others."""
    parts = given.split(",") if isinstance(given, str) else given
    try:
        levels = tuple(float(part) for part in parts)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{given!r} are no densities; expected numbers such as 0.1,0.5") from error
    if len(levels) < 2 or any(not low < high for low, high in pairwise(levels)):
        raise ValueError(f"{given!r}: expected two or more densities, each above the one before")
    return levels


def settings_of(command: click.Command, values: dict[str, Any]) -> dict[str, Any]:
    """Settings of methods by path, removed from the parameter values of a command."""
    of_methods = [param for param in declared(command).values() if param.setting]
    taken = [(param, values.pop(str(param.name))) for param in of_methods]
    return {param.setting: not value if param.inverted else value for param, value in taken if value is not None}


def row_settings(command: click.Command, methods: Sequence[str], values: dict[str, Any]) -> dict[str, dict[str, Plain]]:
    """Settings by method, from the given options of `row_options`; removes these options from `values`.

    Raises:
        UsageError: an option that no method takes.
    """
    options = {param.setting: name for name, param in declared(command).items() if param.setting}
    settings = settings_of(command, values)
    for path in settings:
        if not set(methods) & set(owners := taking(path)):
            raise click.UsageError(f"--{options[path]} is of {', '.join(owners)}; no row is by one of these.")
    return {method: {path: value for path, value in settings.items() if method in taking(path)} for method in methods}


def takers(option: Declared) -> tuple[str, ...]:
    """Names of the methods that have an option."""
    if option.setting:
        return taking(option.setting)
    from recon.auto import Auto  # here, because it loads all methods

    return (*((AUTO,) if option.argument in Auto.takes else ()), *accepting(option.argument))


def refuse_other_methods(command: click.Command, given: Collection[str], method: str, *, stated: bool) -> None:
    """Raise UsageError for a given option that belongs to other methods than this one.

    Args:
        stated: somebody chose the method; else it is the default.
    """
    of_methods = {name: param for name, param in declared(command).items() if param.setting or param.argument}
    asked = {name: param for name, param in of_methods.items() if name in given}
    if method in METHODS and all(param.setting for param in asked.values()):
        own = by_name(method)
        if all(has_setting(own, param.setting) for param in asked.values()):
            return  # without a look at the other methods, which load torch
    owners = {name: takers(param) for name, param in asked.items()}
    for name in (name for name, methods in owners.items() if method not in methods):
        what = f"it does not go with --method {method}." if stated else _instead(name, owners)
        raise click.UsageError(f"--{name} is of {', '.join(owners[name])}; {what}")


def _instead(name: str, owners: Mapping[str, Sequence[str]]) -> str:
    """What to do about an option where no method was chosen: another option may be of other methods alone."""
    others = [other for other, methods in owners.items() if not set(methods) & set(owners[name])]
    if not others:
        return "give --method with one of these."
    return f"--{others[-1]} is of {', '.join(owners[others[-1]])}. Give one of the two options."


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


def slabs_resumed(path: Path | None) -> Path | None:
    """The file of --resume if it is a partial volume; else None."""
    from beamline.storage.writers.partial_volume import is_partial  # here: help does not need it

    return path if path is not None and is_partial(path) else None


SLABS_RESUMED = "resume of slabs"
"""Stands for `--resume` of a partial volume, which has rules of its own."""
_OF_ONE_VOLUME = {
    "roi": "a box belongs to one volume",
    "truth": "a truth is compared with one volume",
    "uncertainty": "error bars belong to one volume",
    **dict.fromkeys(("cluster", SLABS_RESUMED), "several volumes are not made in slabs"),
}
"""Options that several volumes, in time or of materials, do not go with."""

_FINISHED = {"follow": "it is for a finished scan"}
_PLANNED = {"quality": "--quality chooses it"}
_BY_SECONDS = {"follow": "it is for a finished scan; give --seconds"}
NOT_WITH_SLABS = {"follow": "such a run holds everything in memory"}
NOT_WITH_ERROR_BARS = dict.fromkeys(
    ("follow", "budget", "seconds"), "error bars need the whole scan, and time for refits"
)

_STEPS = option(
    "--steps",
    setting="steps",
    excludes={"seconds": "give one of them", **_PLANNED},
    type=WholeRange(min=1),
    help=f"Steps of the fit of Gaussians. Default: {DEFAULT_STEPS}.",
)
_GAUSSIANS = option(
    "--gaussians",
    setting="gaussians",
    excludes=_PLANNED,
    type=WholeRange(min=1),
    help="Number of Gaussians at the start.",
)
_FINISH = option(
    "--finish",
    setting="finish",
    excludes={**_PLANNED, **_FINISHED},
    type=WholeRange(min=0),
    help="Sweeps on voxels after the fit, which bring back edges, cracks and pores; 0: none. Default: 8, and steps "
    "with sparse patches where these predict held-out views better.",
)
_ITERATIONS = option(
    "--iterations",
    setting="iterations",
    type=WholeRange(min=1),
    help="Iterations of an iterative method. Default: depends on the method.",
)
_TV_WEIGHT = option(
    "--tv-weight",
    setting="tv_weight",
    type=POSITIVE,
    help="Weight of the total variation, relative to the density of the sample.",
)
_PATCH_THRESHOLD = option(
    "--patch-threshold",
    setting="patch_threshold",
    type=POSITIVE,
    help="Cosine coefficients of patches up to this threshold are set to 0, relative to the density of the sample. "
    "Default: chosen by held-out views.",
)
_LEVELS = option(
    "--levels",
    setting="levels",
    callback=parsed(levels_of),
    metavar="A,B,...",
    help="Densities of the sample's materials in 1/mm, ascending, for discrete. Default: two to four levels, as "
    "held-out views prefer.",
)
_ALLOW_NEGATIVE = option(
    "--allow-negative",
    setting="allow_negative",
    excludes=_FINISHED,
    is_flag=True,
    help="Keep voxels below zero, also in the sweeps after a fit: where air is not at zero, weak matter is not clipped "
    "with it.",
)
_IN_TIME = together(
    option(
        "--volumes",
        former="--time",
        setting="volumes",
        excludes={**_FINISHED, **_OF_ONE_VOLUME},
        type=WholeRange(min=2),
        metavar="N",
        help="For a sample that changes during the scan: N volumes at even times, in one .h5, from one fit of all "
        "views. Each needs twelve views or more.",
    ),
    option(
        "--moves/--no-moves",
        setting="moves",
        needs=("volumes", "sets volumes in time: give --volumes N with it."),
        default=None,
        help="With --volumes: matter moves, or only its density changes. Default: chosen by held-out views.",
    ),
)
row_options = together(heading(METHOD), _STEPS, _GAUSSIANS, _FINISH, _ITERATIONS, _TV_WEIGHT, _PATCH_THRESHOLD)
"""The options of methods for every row of a table: length and start of the work."""
equal_time = option(
    "--seconds",
    excludes={
        "iterations": "give one of them",
        **dict.fromkeys(("volumes", "spectra"), "it belongs to methods that make one volume"),
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
    option(
        "--seconds",
        setting="seconds",
        excludes=_PLANNED,
        type=POSITIVE,
        help="Time of the whole call, instead of --steps: the fit gets what reading, correction, report and writing "
        "leave, which it does not shorten. If that is nothing, a warning says when the call will end. With --follow: "
        "most time after the end of the scan.",
    ),
    option(
        "--budget",
        argument="budget",
        excludes={"quality": "give one of them", **_BY_SECONDS},
        callback=parsed(parse_budget),
        metavar="30s|2m|1h",
        help="Time from line integrals to volume: auto leaves out the methods whose forecast is longer.",
    ),
    option(
        "--quality",
        argument="quality",
        excludes=_BY_SECONDS,
        type=NameChoice(list(PRESETS)),
        help="Preset of steps and Gaussians; of auto, of what is tried.",
    ),
    _GAUSSIANS,
    option(
        "--start",
        setting="start",
        excludes=_FINISHED,
        type=NameChoice(get_args(Start)),
        help="Volume that the first Gaussians are drawn from; tv: slower, no streaks of few views; published: with the "
        "plain ramp, drawn and weighted as published. Default: fbp; published by r2-published.",
    ),
    option(
        "--loss",
        setting="fit.loss",
        type=NameChoice(get_args(Loss)),
        help="Loss of the fit, beside SSIM: absolute, squared, or squares weighted by photon noise. Default: l1.",
    ),
    option(
        "--kernel",
        setting="fit.kernel",
        type=NameChoice([kernel.value for kernel in Kernel]),
        help="Shape of the Gaussians: true ones, or compact ones that end, (1 - r²/8)^1.5. "
        f"Default: {KERNEL}; gaussian by r2-published.",
    ),
    heading(RESOURCES),
    option(
        "--device",
        argument="device",
        excludes=_FINISHED,
        default="cpu",
        show_default=True,
        metavar="cpu|cuda",
        help="Device that computes the fit, total variation and patches.",
    ),
    heading(METHOD),
    option(
        "--early-stop",
        setting="early_stop",
        excludes=_FINISHED,
        is_flag=True,
        help="End the fit when held-out views stop improving; holds out every tenth unless --views does.",
    ),
    _FINISH,
    heading(OUTPUT),
    option(
        "--checkpoint",
        argument="checkpoints",
        excludes=_FINISHED,
        of_one_call=True,
        type=click.Path(path_type=Path, dir_okay=False),
        callback=parsed(checkpoint_output),
        help="Write the state of the fit to this file: every minute, at the end, and at Ctrl-C.",
    ),
    option(
        "--resume",
        argument="checkpoints",
        excludes=_FINISHED,
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
    _LEVELS,
    _ALLOW_NEGATIVE,
    _IN_TIME,
    option(
        "--plain-splatting",
        setting="fit.rays.rectified",
        inverted=True,
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
