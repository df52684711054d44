"""Options of the reconstruction methods, and which of them can be combined."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import click

from beamline.cli.options import POSITIVE, Declared, NameChoice, WholeRange, declared, option, parsed, together
from beamline.cli.recipe import METHOD, OUTPUT, RESOURCES, heading, names_of_recipe
from beamline.core.errors import DataError
from beamline.reconstruct.combinations import EXCLUDED
from recon.assess.time_model import PRESETS, parse_budget
from recon.base.choices import AUTO, KERNEL, Loss, Start
from recon.base.empirical import DEFAULT_STEPS
from recon.base.kernel import Kernel
from recon.base.method import Method, Plain
from recon.methods import METHODS, accepting, build, by_name, has_setting, taking


def checkpoint_output(path: Path) -> Path:
    """The path of a checkpoint to write. Raises ValueError for a path without a file name."""
    if not path.name:
        raise ValueError(f"{str(path)!r} is not a file name; expected a name such as fit.checkpoint.h5")
    return path


def checkpoint_input(ctx: click.Context, param: click.Parameter, path: Path | None) -> Path | None:
    """A callback that checks the path of a checkpoint to read. Raises DataError if the file does not exist."""
    if path is not None and not path.exists():
        raise DataError(f"--{param.name} {path} does not exist. Nothing was changed.")
    return path


def levels_of(stated_levels: str | Sequence[float]) -> tuple[float, ...]:
    """Densities from text such as "0.1,0.5", or from a list in a recipe. Raises ValueError for other values."""
    parts = stated_levels.split(",") if isinstance(stated_levels, str) else stated_levels
    try:
        levels = tuple(float(part) for part in parts)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{stated_levels!r} is not a list of densities; expected numbers such as 0.1,0.5") from error
    if len(levels) < 2 or any(not low < high for low, high in pairwise(levels)):
        raise ValueError(f"{stated_levels!r}: expected two or more densities in ascending order")
    return levels


def settings_of(command: click.Command, values: dict[str, Any]) -> dict[str, Any]:
    """Remove the settings of methods from the parameter values of a command, and return them by path."""
    of_methods = [param for param in declared(command).values() if param.setting]
    taken = [(param, values.pop(str(param.name))) for param in of_methods]
    return {param.setting: not value if param.inverted else value for param, value in taken if value is not None}


def row_settings(command: click.Command, methods: Sequence[str], values: dict[str, Any]) -> dict[str, dict[str, Plain]]:
    """Settings by method, from the given options of `row_options`. These options are removed from `values`.

    Raises: UsageError: no method takes a given option.
    """
    options = {param.setting: name for name, param in declared(command).items() if param.setting}
    settings = settings_of(command, values)
    for path in settings:
        if not set(methods) & set(owners := taking(path)):
            methods_with_it = ", ".join(owners)
            option = options[path]
            raise click.UsageError(
                f"--{option} works only with {methods_with_it}; this command uses only {', '.join(methods)}."
            )
    return {method: {path: value for path, value in settings.items() if method in taking(path)} for method in methods}


def takers(option: Declared) -> tuple[str, ...]:
    """Names of the methods that an option belongs to."""
    if option.setting:
        return taking(option.setting)
    from recon.auto import Auto  # imported here because it loads all methods

    return (*((AUTO,) if option.argument in Auto.takes else ()), *accepting(option.argument))


def refuse_other_methods(context: click.Context, given_names: Collection[str], method: str, *, stated: bool) -> None:
    """Raise UsageError for a given option that belongs to other methods than this one.

    Args:
        stated: True if the user chose the method; False if it is the default.
    """
    of_methods = {name: param for name, param in declared(context.command).items() if param.setting or param.argument}
    given_params = {name: param for name, param in of_methods.items() if name in given_names}
    if method in METHODS and all(param.setting for param in given_params.values()):
        own = by_name(method)
        if all(has_setting(own, param.setting) for param in given_params.values()):
            return  # checked before the other methods are asked, because they load torch
    owners = {name: takers(param) for name, param in given_params.items()}
    for name in (name for name, methods in owners.items() if method not in methods):
        advice = f"it cannot be combined with --method {method}." if stated else _instead(name, owners)
        origin = " comes from --config, and it" if name in names_of_recipe(context) else ""
        raise click.UsageError(f"--{name}{origin} works only with {', '.join(owners[name])}; {advice}")


def _instead(name: str, owners: Mapping[str, Sequence[str]]) -> str:
    """What the user can do about an option if no method was chosen. (Another given option may belong only to other
    methods.)"""
    others = [other for other, methods in owners.items() if not set(methods) & set(owners[name])]
    if not others:
        return "add --method with one of these methods."
    second = others[-1]
    return (
        f"--{second} works only with {', '.join(owners[others[-1]])}. No method has both options: leave out one of "
        "the two options."
    )


def method_with(name: str, settings: Mapping[str, Any], any_setting: Mapping[str, Any] | None = None) -> Method:
    """The method of this name with its settings. Settings of other methods are ignored.

    Args:
        name: name of a method in `recon.methods`, or that of `recon.Auto`.
        settings: values by path.
        any_setting: values by path from `--set`. The method must have every one of these settings.
    """
    if name == AUTO:
        from recon.auto import Auto  # imported here because it loads all methods

        return Auto(tuple(method_with(each.name, settings, any_setting) for each in Auto().candidates))
    method = by_name(name)
    its_own = {path: value for path, value in settings.items() if has_setting(method, path)}
    further = {path: tuple(value) if isinstance(value, list) else value for path, value in (any_setting or {}).items()}
    try:
        return build(method, its_own | further)
    except (ValueError, TypeError) as error:
        raise click.UsageError(f"--set: {error}. Nothing was computed.") from error


def settings_given(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> dict[str, Any]:
    """Parse settings by name from texts of NAME=VALUE separated by spaces. A value is JSON; if it is not valid JSON, it
    is plain text."""
    settings: dict[str, Any] = {}
    for word in " ".join(values).split():
        name, equals, text = word.partition("=")
        if not (name and equals and text):
            raise click.BadParameter(f"{word!r} is not a setting; expected NAME=VALUE, such as fit.decay=0.1")
        try:
            settings[name] = json.loads(text)
        except ValueError:
            settings[name] = text
    return settings


def slabs_resumed(path: Path | None) -> Path | None:
    """The file of --resume if it is a partial volume; else None."""
    from beamline.storage.writers.partial_volume import is_partial  # imported here because help does not need it

    return path if path is not None and is_partial(path) else None


_STEPS = option(
    "--steps",
    setting="steps",
    excludes=EXCLUDED["steps"],
    type=WholeRange(min=1),
    help=f"Number of steps of the Gaussian fit (r2). Default: {DEFAULT_STEPS}.",
)
_GAUSSIANS = option(
    "--gaussians",
    setting="gaussians",
    excludes=EXCLUDED["gaussians"],
    type=WholeRange(min=1),
    help="Number of Gaussians at the start of the fit (r2). Default: chosen from the size of the detector.",
)
_FINISH = option(
    "--finish",
    setting="finish",
    excludes=EXCLUDED["finish"],
    type=WholeRange(min=0),
    help="Number of iterations on the voxel volume after the Gaussian fit; these iterations restore edges, cracks and "
    "pores. 0: none. Default: 8 iterations with total variation, then more with discrete levels or PnP-DCT, if "
    "discrete levels or PnP-DCT predict held-out projections better.",
)
_ITERATIONS = option(
    "--iterations",
    setting="iterations",
    type=WholeRange(min=1),
    help="Number of iterations, for the methods that iterate on voxels. fista-tv, discrete and os-sirt-tv end earlier "
    "if the volume has converged. Default: a number for each method, for example 60 for fista-tv.",
)
_TV_WEIGHT = option(
    "--tv-weight",
    setting="tv_weight",
    type=POSITIVE,
    help="Regularisation weight of the total variation, relative to the density of the sample: a larger weight gives a "
    "smoother volume. Default: chosen with held-out projections.",
)
_PATCH_THRESHOLD = option(
    "--patch-threshold",
    setting="patch_threshold",
    type=POSITIVE,
    help="Threshold of the PnP-DCT denoiser, relative to the density of the sample: smaller cosine coefficients of a "
    "patch are set to 0. Default: chosen with held-out projections.",
)
_LEVELS = option(
    "--levels",
    setting="levels",
    callback=parsed(levels_of),
    metavar="A,B,...",
    help="Densities of the materials of the sample in 1/mm, in ascending order, for discrete. Default: two to four "
    "levels, chosen with held-out projections.",
)
_ALLOW_NEGATIVE = option(
    "--allow-negative",
    setting="allow_negative",
    excludes=EXCLUDED["allow-negative"],
    is_flag=True,
    help=(
        "Do not set negative voxels to zero, neither in the method nor in the voxel refinement (--finish). Use this "
        "option if the air level is below zero, because setting voxels to zero then also removes weakly absorbing "
        "material."
    ),
)
_WITH_REFERENCE = option(
    "--reference",
    argument="reference",
    excludes=EXCLUDED["reference"],
    type=click.Path(path_type=Path),
    metavar="GOOD",
    help="Earlier volume of the same sample, or an earlier scan of the sample, which is then reconstructed first. "
    "The motion of the sample since the earlier scan, and the grey level of each particle, are estimated from "
    "the projections. Held-out projections decide whether the earlier volume is used. If the earlier volume is "
    "not used, the method is chosen as with auto.",
)
_IN_TIME = together(
    option(
        "--volumes",
        former="--time",
        setting="volumes",
        excludes=EXCLUDED["volumes"],
        type=WholeRange(min=2),
        metavar="N",
        help="For a sample that changes during the scan: reconstruct N volumes at equal time steps, from one fit of "
        "all projections, into one .h5. Each volume needs at least 12 projections. Default: one volume.",
    ),
    option(
        "--moves/--no-moves",
        setting="moves",
        needs=("volumes", "applies to a time series: add --volumes N."),
        default=None,
        help=(
            "With --volumes: state whether the material moves or only its density changes. Default: chosen with "
            "held-out projections."
        ),
    ),
)
row_options = together(heading(METHOD), _STEPS, _GAUSSIANS, _FINISH, _ITERATIONS, _TV_WEIGHT, _PATCH_THRESHOLD)
"""The options of methods for every row of a table. They set the length and the start of the work."""
equal_time = option(
    "--seconds",
    excludes={
        "iterations": "give one of them",
        **dict.fromkeys(("volumes", "spectra"), "this option belongs to methods that reconstruct a single volume"),
    },
    type=POSITIVE,
    metavar="EACH",
    help="Compare the methods in equal time: each reconstruction stops after this number of seconds. fbp, cgls, "
    "pnp-dct and discrete ignore this limit and take the time they need.",
)
"""The time limit for every row of a table."""
method_options = together(
    heading(METHOD),
    _STEPS,
    option(
        "--seconds",
        setting="seconds",
        excludes=EXCLUDED["seconds"],
        type=POSITIVE,
        help="Time limit in seconds for the whole command, instead of --steps. Reading, correction, report and writing "
        "take the time they need; the fit gets the rest. If nothing is left for the fit, a warning says when the "
        "command will end. With --follow: time limit after the end of the scan.",
    ),
    option(
        "--budget",
        argument="budget",
        excludes=EXCLUDED["budget"],
        callback=parsed(parse_budget),
        metavar="30s|2m|1h",
        help="Time limit of the reconstruction itself, without reading and correction: auto does not try methods that "
        "are expected to take longer. Default: no limit.",
    ),
    option(
        "--quality",
        argument="quality",
        excludes=EXCLUDED["quality"],
        type=NameChoice(list(PRESETS)),
        help="Preset. For r2: number of steps and of Gaussians (preview: 125 steps and half the Gaussians; standard: "
        "400 steps; best: 1500 steps). For fista-tv, discrete and os-sirt-tv: when the iterations end (preview: "
        "earlier; best: later, and fista-tv and discrete also use voxels of half a pixel). For auto: preview tries "
        "only fbp and fista-tv; best tries all methods and accepts any improvement. Default: standard.",
    ),
    _GAUSSIANS,
    option(
        "--start",
        setting="start",
        excludes=EXCLUDED["start"],
        type=NameChoice(get_args(Start)),
        help="Volume from which the initial Gaussians are sampled. tv: slower, but without the streaks of few "
        "projections. published: FBP with a plain ramp filter, sampled and weighted as in the R²-Gaussian paper. "
        "Default: fbp; for r2-published: published.",
    ),
    option(
        "--loss",
        setting="fit.loss",
        type=NameChoice(get_args(Loss)),
        help="Loss of the Gaussian fit, in addition to SSIM: l1 (absolute differences), l2 (squared differences) or "
        "poisson (squared differences weighted by the photon noise). Default: l1.",
    ),
    option(
        "--kernel",
        setting="fit.kernel",
        type=NameChoice([kernel.value for kernel in Kernel]),
        help="Shape of the Gaussians. gaussian: true Gaussians. compact:1.5: the function (1 - r²/8)^1.5, which is "
        f"zero beyond a finite radius. Default: {KERNEL}; for r2-published: gaussian.",
    ),
    heading(RESOURCES),
    option(
        "--device",
        argument="device",
        excludes=EXCLUDED["device"],
        default="cpu",
        show_default=True,
        metavar="cpu|cuda",
        help="Processor or graphics card that computes the Gaussian fit, total variation and PnP-DCT.",
    ),
    heading(METHOD),
    option(
        "--early-stop",
        setting="early_stop",
        excludes=EXCLUDED["early-stop"],
        is_flag=True,
        help="Stop the fit when the residual in the held-out projections no longer falls. Every tenth projection is "
        "held out, unless --views already leaves some out.",
    ),
    _FINISH,
    heading(OUTPUT),
    option(
        "--checkpoint",
        argument="checkpoints",
        excludes=EXCLUDED["checkpoint"],
        of_one_call=True,
        type=click.Path(path_type=Path, dir_okay=False),
        callback=parsed(checkpoint_output),
        help="Save the state of the fit in this file every minute, at the end and at Ctrl-C, so that --resume can "
        "continue the fit.",
    ),
    option(
        "--resume",
        argument="checkpoints",
        excludes=EXCLUDED["resume"],
        of_one_call=True,
        callback=checkpoint_input,
        type=click.Path(path_type=Path, dir_okay=False),
        help="Continue from this file: a fit from its checkpoint, or a volume in slabs from its OUTPUT.partial.h5. "
        "Give the data and options of the interrupted command.",
    ),
    heading(METHOD),
    _ITERATIONS,
    _TV_WEIGHT,
    _PATCH_THRESHOLD,
    _LEVELS,
    _ALLOW_NEGATIVE,
    _WITH_REFERENCE,
    _IN_TIME,
    option(
        "--plain-splatting",
        setting="fit.rays.rectified",
        inverted=True,
        is_flag=True,
        help=(
            "Project the Gaussians as 3D Gaussian splatting does: all rays have the same path length through a "
            "Gaussian. This causes a bias, which the default avoids. Use this option only for comparison."
        ),
    ),
    option(
        "--set",
        "any_setting",
        multiple=True,
        metavar="NAME=VALUE",
        callback=settings_given,
        help="Any setting of the method by its name in Python, for example fit.decay=0.1 or fit.policy.every=50. "
        "Can be given several times.",
    ),
)
"""The options of the Gaussian fit and of the iterative methods."""
