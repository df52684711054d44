"""`beamline sweep`: reconstructs one slice with each value of an option of `recon`, and draws them with scores."""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING

import click

from beamline.cli.options import Declared, json_option, name_of, new_folder_option
from beamline.cli.recipe import names_given
from beamline.cli.recon import options_of, recon
from beamline.core.text import NUMBER, safe_name
from recon.base.registry import did_you_mean
from recon.methods import BASELINE

if TYPE_CHECKING:
    from beamline.reconstruct.options import ReconOptions

_OF_A_VOLUME = frozenset(
    ("output", "report", "write-config", "json", "dry-run", "max-residual", "truth", "uncertainty",
     "roi", "follow", "previous-part", "memory", "cluster", "checkpoint", "resume", "budget",
     "volumes", "moves", "beside-scan")
)  # fmt: skip
"""Options of `beamline recon` that have no effect on a single slice."""

MOST = 64
"""Largest number of slices in one picture: 16 rows of four slices, which `sheets` draws 3200 pixels high."""
# names that other programs use for the option axis
_AXIS = "center", "centre", "center-of-rotation", "centre-of-rotation", "cor", "rotation-axis"
_SIGNED = rf"[-+]?{NUMBER}"
_RANGE = re.compile(rf"({_SIGNED}):({_SIGNED}):({_SIGNED})")


@dataclass(frozen=True)
class SweptOption:
    """An option and the values to try, as the user typed them.

    Attributes:
        name: long name of the option, without dashes.
    """

    name: str
    values: tuple[str, ...]


def swept_option(text: str, legal: Collection[str]) -> SweptOption:
    """The option and values of NAME=A:B:STEP or NAME=a,b,c.

    Args:
        legal: long names of the options that can be swept; "_" in a name counts as "-".

    Raises: ValueError: the name is unknown (the message suggests the most similar one), or there are too few values.
    """
    name, equals, values = text.partition("=")
    name = name.strip().lstrip("-").replace("_", "-")
    if not equals:
        raise ValueError(f"{text!r} is not an option with values; expected NAME=A:B:STEP or NAME=a,b,c")
    if name not in legal:
        near = " (did you mean axis?)" if name in _AXIS else did_you_mean(name, legal)
        raise ValueError(
            f"{name!r} cannot be swept{near}. You can sweep the options that `beamline recon --help-all` lists under "
            "Data, Corrections and Method, such as tv-weight, rings or axis"
        )
    tried = _values(name, values)
    if len(tried) < 2:
        advice = "".join(f". For a single value use `beamline recon --{name} {value}`" for value in tried)
        raise ValueError(
            f"a sweep needs at least two values, as NAME=A:B:STEP or NAME=a,b,c, but {text!r} has {len(tried)}{advice}"
        )
    return SweptOption(name, tried)


def _values(name: str, text: str) -> tuple[str, ...]:
    match = _RANGE.fullmatch(text.strip())
    if match is None:
        return tuple(dict.fromkeys(value for value in (word.strip() for word in text.split(",")) if value))
    first, last, step = map(Decimal, match.groups())
    if step == 0 or (last - first) / step <= 0:
        raise ValueError(
            f"{name}={text}: a step of {step} does not lead from {first} to {last}; expected a step other than 0, "
            "with a minus sign if the values fall"
        )
    steps = int((last - first) / step)
    if steps >= MOST:
        n_values = steps + 1
        raise ValueError(f"{name}={text} has {n_values} values, but at most {MOST} are possible: use a larger STEP")
    return tuple(f"{first + n * step:f}" for n in range(steps + 1))


def combinations(options: Sequence[SweptOption]) -> list[Mapping[str, str]]:
    """All combinations of values, by name; the last option varies fastest.

    Raises: ValueError: there are not one or two different options, or there are too many combinations.
    """
    names = [option.name for option in options]
    if not 1 <= len(names) <= 2 or len(set(names)) < len(names):
        given_options = ", ".join(names) or "none"
        raise ValueError(
            f"{len(names)} options are given ({given_options}); expected one option, or two different options"
        )
    combined: list[Mapping[str, str]] = [
        dict(zip(names, values, strict=True)) for values in itertools.product(*(option.values for option in options))
    ]
    if len(combined) > MOST:
        raise ValueError(f"there are {len(combined)} combinations, but at most {MOST} are possible: give fewer values")
    return combined


Trials = list[tuple[Mapping[str, str], "ReconOptions"]]


def sweepable() -> dict[str, click.Option]:
    """The options of `beamline recon` that can be swept, by long name."""
    own = {name_of(param): param for param in recon.params if isinstance(param, click.Option)}
    of_one_call = {name for name, param in own.items() if isinstance(param, Declared) and param.of_one_call}
    return {name: own[name] for name in sorted(own.keys() - _OF_A_VOLUME - of_one_call)}


@click.command(context_settings={"ignore_unknown_options": True, "help_option_names": ["-h", "--help"]})
@click.argument("words", nargs=-1, type=click.UNPROCESSED, metavar="FILE|RUN NAME=VALUES [NAME=VALUES]")
@new_folder_option("FILE's stem + _sweep")
@json_option
def sweep(words: tuple[str, ...], output: Path | None, as_json: bool) -> None:
    """Reconstruct one slice with each value of an option of `beamline recon`, and draw the slices with their scores.

    \b
    beamline sweep SCAN.h5 axis=84:88:0.5
    beamline sweep SCAN.h5 rings=none,sort,vo
    beamline sweep SCAN.h5 tv-weight=0.001,0.002,0.004 -m fista-tv

    NAME is the long name of the option. VALUES are A:B:STEP or a,b,c. Two options give a grid of slices. All other
    options of `beamline recon` apply to every slice; without -m the method is fbp.

    One of eight projections is held out, and the score of each value is the residual in the held-out projections. The
    best value is marked, and so are values that do not differ significantly from it. The slice is the middle row of
    the detector, or of --rows. The command writes a folder with sweep.csv, pictures and report.html.

    Ctrl-C keeps the slices that are done (exit code 4). Before the first slice is done, Ctrl-C leaves no folder (exit
    code 130).
    """
    from beamline.features.trials.runner import compare
    from beamline.features.trials.sweep import planned_sweep

    options, common = _parsed(words)
    trials = _trials(options, common)
    file = trials[0][1].source.path
    folder = output or Path(f"{safe_name(Path(file).stem)}_sweep")
    plan = partial(planned_sweep, trials, shlex.join(["beamline", "sweep", *words]))
    table = compare(plan, file, folder, as_json=as_json)
    if not as_json and table.best is not None:
        option_words = [word for name, value in table.best.items() for word in _as_words(name, str(value))]
        recon_command = shlex.join(["beamline", "recon", *common, *option_words])
        click.echo(
            f"If the pictures confirm the best value, use: {recon_command}",
            err=True,
        )


def _parsed(words: Sequence[str]) -> tuple[list[SweptOption], list[str]]:
    """The options with their values, and the words of the command `beamline recon` that are common to all slices. The
    scan comes first."""
    with click.Context(recon, info_name="sweep") as context:
        taken, further, _ = recon.make_parser(context).parse_args(list(words))
    if (file := taken.get("file")) is None or not further:
        raise click.UsageError("expected a scan and an option with its values, such as tv-weight=0.5:4:0.5.")
    rest = list(words)
    for word in (str(file), *further):
        rest.remove(word)
    try:
        options = [swept_option(word, sweepable()) for word in further]
        combinations(options)
    except ValueError as error:
        raise click.UsageError(f"{error}.") from error
    return options, [str(file), *rest]


def _as_words(name: str, value: str) -> list[str]:
    """An option with a value, as words for `beamline recon`. Raises UsageError for a flag that is not true or false."""
    switch = sweepable()[name]
    if not switch.is_flag:
        return [f"--{name}={value}"]
    if value not in ("true", "false"):
        raise click.UsageError(f"{name}={value}: this option can only be on or off; expected {name}=false,true.")
    names = switch.opts if value == "true" else switch.secondary_opts
    return [max(names, key=len)] if names else []


def _trials(options: Sequence[SweptOption], common: Sequence[str]) -> Trials:
    """Each combination of values, with the options of its reconstruction. Raises UsageError for values that are not
    allowed, or that have no effect."""
    trials: Trials = []
    for values in combinations(options):
        own = [word for item in values.items() for word in _as_words(*item)]
        with recon.make_context("sweep", [*common, *own]) as context:
            trials.append((values, _options(context)))
        if len(trials) == 1:
            with recon.make_context("sweep", list(common)) as alone:
                twice = names_given(alone) & values.keys()
            if twice:
                raise click.UsageError(
                    f"--{min(twice)} is given twice: once as an option and once with values to sweep. Leave out the "
                    "option."
                )
    settings = [
        (repr((each.source, each.selection, each.method)), each.quality, each.seed, each.device) for _, each in trials
    ]
    if all(each == settings[0] for each in settings[1:]):
        names = " and ".join(option.name for option in options)
        method_name = trials[0][1].method.name
        raise click.UsageError(f"{names} changes nothing in a slice made with {method_name}.")
    return trials


def _options(context: click.Context) -> ReconOptions:
    """The options of a reconstruction whose volume is not written."""
    from beamline.reconstruct.options import OutputPaths

    if foreign := sorted(names_given(context) & _OF_A_VOLUME):
        option = foreign[0]
        raise click.UsageError(
            f"--{option} works only with whole volumes, but a sweep makes slices: leave out --{option}."
        )
    target = OutputPaths(Path(gettempdir()) / "slice.h5", None, replace=True, written=False)
    return replace(options_of(context, BASELINE), target=target)
