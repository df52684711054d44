"""Arguments and options that several commands share: parsing, rules between options, and the output of --json."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import field, fields
from datetime import datetime
from functools import wraps
from pathlib import Path
from types import MappingProxyType
from typing import Any

import click
from click.exceptions import ClickException, Exit

from beamline.core.errors import exit_code, user_message
from beamline.core.events import Event, Failed, Sink
from beamline.core.files import same_file
from beamline.core.sinks import JsonLines, fan_out
from drivers.base.clock import SystemClock
from recon.base.registry import unknown
from recon.base.setting import Setting
from recon.methods import METHODS


def _within(bounds: click.FloatRange | click.IntRange, number: Any, *place: Any) -> Any:
    """Returns the number if it is within the bounds. Otherwise raises a usage error with the same message as in
    Python.
    """
    low, high = "gt" if bounds.min_open else "ge", "lt" if bounds.max_open else "le"
    limits: dict[str, Any] = {low: bounds.min, high: bounds.max}
    if fault := Setting(**limits).fault(number):
        bounds.fail(f"{number}; {fault}.", *place)
    return number


def _bounds_text(bounds: click.FloatRange | click.IntRange) -> str:
    """The bounds for the help of an option: `at least 1`, `above 0`, `0 to 65535`; empty without bounds."""
    low, high = bounds.min, bounds.max
    if low is not None and high is not None:
        return f"{low} to {high}"
    if low is not None:
        return f"{'above' if bounds.min_open else 'at least'} {low}"
    return "" if high is None else f"{'below' if bounds.max_open else 'at most'} {high}"


class FiniteRange(click.FloatRange):
    """A range of finite numbers. (The range of click accepts NaN and infinities.)"""

    name = "number"

    def _describe_range(self) -> str:
        return _bounds_text(self)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return _within(self, click.FLOAT.convert(value, param, ctx), param, ctx)


class WholeRange(click.IntRange):
    """A range of whole numbers."""

    name = "n"

    def _describe_range(self) -> str:
        return _bounds_text(self)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return _within(self, click.INT.convert(value, param, ctx), param, ctx)


class NameChoice(click.Choice):  # type: ignore[type-arg]
    """A choice of names. The error for an unknown name suggests the most similar one."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            self.fail(self.refusal(value), param, ctx)

    def refusal(self, value: str) -> str:
        return unknown("", value, self.choices)


class MethodChoice(NameChoice):
    """A choice of methods. If another command runs the method, the error names this command."""

    def refusal(self, value: str) -> str:
        return unknown_method(value, self.choices)


def unknown_method(name: str, legal: Iterable[str]) -> str:
    """The reason why a method cannot be chosen here, as a sentence without its full stop."""
    if (entry := METHODS.get(name)) is not None and entry.several in _ELSEWHERE:
        return f"{name!r} {_ELSEWHERE[entry.several]}"
    return unknown("method", name, legal)


_ELSEWHERE = {
    "times": "makes a series of volumes at successive times, which only `beamline recon --volumes N` can make",
}
"""The command that runs a method that makes several volumes."""

POSITIVE = FiniteRange(min=0, min_open=True)
NOT_NEGATIVE = FiniteRange(min=0)
SEED = WholeRange(min=0)

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class Declared(click.Option):
    """A click option that states which methods it belongs to, and with which options it can be combined.

    Args:
        setting: path of a setting in Python, such as `fit.loss`; the option belongs to the methods with this setting.
        argument: name of an argument of methods (see `Method.takes`); the option belongs to the methods with this
            argument. inverted: True for a flag that switches the setting off.
        excludes: long names of options that cannot be combined with this option, each with the reason.
        needs: another option that this one requires, and the end of the error message if it is missing.
        of_one_call: True if the option belongs to one scan or one call; it is then not written into a recipe.
        former: long name of the option in the previous version. It is still accepted, but the help does not show it.
    """

    def __init__(
        self,
        *args: Any,
        setting: str = "",
        argument: str = "",
        inverted: bool = False,
        excludes: Mapping[str, str] = MappingProxyType({}),
        needs: tuple[str, str] | None = None,
        of_one_call: bool = False,
        former: str = "",
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.setting, self.argument, self.inverted = setting, argument, inverted
        self.excludes, self.needs, self.of_one_call, self.former = excludes, needs, of_one_call, former

    def add_to_parser(self, parser: Any, ctx: click.Context) -> None:
        shown, self.opts = self.opts, [*self.opts, *filter(None, [self.former])]
        super().add_to_parser(parser, ctx)
        self.opts = shown


def option(*names: str, **facts: Any) -> Decorator:
    """`click.option` that makes a `Declared` option."""
    return click.option(*names, cls=Declared, **facts)


def name_of(option: click.Option) -> str:
    """The long name of the option, without its dashes."""
    return max(option.opts, key=len).lstrip("-")


def declared(command: click.Command) -> dict[str, Declared]:
    """The `Declared` options of a command, by their long names."""
    return {name_of(param): param for param in command.params if isinstance(param, Declared)}


def refuse_contradictions(
    command: click.Command, given_names: Collection[str], shown: Mapping[str, str] = MappingProxyType({})
) -> None:
    """Raise UsageError if two given options exclude each other, or if a given option requires another one that is
    missing.

    Args:
        given_names: long names of the options that the user gave, and names of other conditions that options may
            exclude.
        shown: the words for these conditions in error messages.
    """
    for name, param in declared(command).items():
        if name not in given_names:
            continue
        for excluded in (excluded for excluded in param.excludes if excluded in given_names):
            reason = f"{shown.get(excluded, f'--{excluded}')}: {param.excludes[excluded]}"
            raise click.UsageError(f"--{name} cannot be combined with {reason}. Nothing was computed.")
        if param.needs is not None and param.needs[0] not in given_names:
            raise click.UsageError(f"--{name} {param.needs[1]}")


config_argument = click.argument("file", metavar="CONFIG", type=click.Path(path_type=Path))
set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Replace a value of the configuration, for example scan.period_s=0.2. Can be given several times.",
)
json_option = option(
    "--json", "as_json", is_flag=True, of_one_call=True,
    help="Print JSON to stdout, one event per line, instead of text.",
)  # fmt: skip
seed_option = option(
    "--seed",
    type=SEED,
    default=0,
    show_default=True,
    help="Seed of all random numbers. The same seed gives the same result.",
)
dataset_option = option(
    "--dataset",
    help="Name of the array, if an HDF5 or .npz file holds several. Default: the only array with three axes.",
)


def new_folder_option(default: str) -> Decorator:
    """Option -o of a command that writes several files; `default` describes the folder used without the option."""
    path_type = click.Path(path_type=Path, file_okay=False)
    return option(
        "-o", "--output", type=path_type, help=f"New folder for the results. Default: {default}, in the current folder."
    )


def together(*options: Decorator) -> Decorator:
    """A decorator that adds these options, in this order."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return add


def set_by(*options: Decorator | str, **facts: Any) -> Any:
    """A field of the request of a command, with the option that sets it.

    Args:
        options: names of the option; or an option or argument that was already made, whose parameter has the name of
            the field. Headings may come before it.
        facts: keyword arguments of `option`.
    """
    return field(metadata={"options": options, "facts": facts})


def others(*options: Decorator) -> Any:
    """A request field that collects the values of these options by parameter name."""
    return field(metadata={"options": options})


def with_request(request: type) -> Decorator:
    """A decorator that adds the options of the fields of a request, in their order, and calls the command with the
    request.

    Args:
        request: a frozen dataclass whose fields are made by `set_by`; one field may be made by the function `others`.
    """
    fields_of = {each.name: each.metadata for each in fields(request)}

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def call(**values: Any) -> Any:
            own = {name: values.pop(name) for name, made in fields_of.items() if "facts" in made}
            return command(request(**own, **{name: values for name in fields_of if name not in own}))

        return together(*(each for name, made in fields_of.items() for each in _options_of(name, **made)))(call)

    return add


def _options_of(
    field: str, options: Sequence[Decorator | str], facts: Mapping[str, Any] | None = None
) -> list[Decorator]:
    """The headings and the option of a field."""
    names = [each for each in options if isinstance(each, str)]
    return [each for each in options if not isinstance(each, str)] + (
        [option(*names, field, **(facts or {}))] if names else []
    )


def parsed(parse: Callable[[Any], Any]) -> Callable[[click.Context, click.Parameter, Any], Any]:
    """A callback that parses an option with `parse`. A ValueError of `parse` becomes a usage error."""

    def callback(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
        try:
            return None if value is None else parse(value)
        except ValueError as error:
            raise click.BadParameter(str(error)) from error

    return callback


def as_scan(ctx: click.Context, param: click.Parameter, value: Path) -> Path:
    """A callback that replaces the folder of a run by its scan file with all parts."""
    from beamline.storage.interrupted import scan_file  # imported here because help does not need it

    return scan_file(value)


def _as_volume(ctx: click.Context, param: click.Parameter, value: Path) -> Path:
    from beamline.storage.interrupted import volume_file

    return volume_file(value)


scan_argument = click.argument("file", metavar="FILE|RUN", type=click.Path(path_type=Path), callback=as_scan)
"""Type of an argument for a scan: its file, or the folder of a run. A folder means the scan file of the run with all
parts."""
volume_argument = click.argument("volume", metavar="VOLUME|RUN", type=click.Path(path_type=Path), callback=_as_volume)
"""Type of an argument for a volume: its file, or the folder of a run. A folder means the file recon.h5 in it."""


def volume_path(text: str) -> Path:
    """Check that the suffix of a path names a format of volumes. Raises ValueError otherwise."""
    from beamline.storage.volumes.files import format_of  # imported here because help does not need it

    format_of(Path(text))
    return Path(text)


def refuse_shared(files: Mapping[str, Path | None]) -> None:
    """Raise UsageError if two of `files` (by option) are the same file, because one would overwrite the other.

    Only --checkpoint may replace the file of --resume.
    """
    named = [(option, path) for option, path in files.items() if path is not None]
    for (first, path), (second, second_path) in itertools.combinations(named, 2):
        if {first, second} != {"--checkpoint", "--resume"} and same_file(path, second_path):
            raise click.UsageError(f"{first} and {second} are the same file, {second_path}. Give two different files.")


@contextmanager
def json_events(as_json: bool) -> Iterator[Sink]:
    """The sink that prints JSON to stdout; without `as_json` it does nothing. An error becomes the event `failed`.

    Other text that is printed in the block, for example by a plug-in, goes to stderr, so that stdout has only JSON.
    """
    if not as_json:
        yield fan_out()
        return
    lines = JsonLines(sys.stdout)
    last: list[Event] = []
    try:
        with redirect_stdout(sys.stderr):
            yield fan_out(last.append, lines)
    except (Exit, ClickException):
        raise
    except BaseException as error:
        if not (last and last[-1].event in ("done", "failed")):
            lines(Failed(user_message(error), exit_code(error), time=SystemClock().now()))
        raise


def say(line: str) -> None:
    """Print a line with the time of day to stderr."""
    click.echo(f"{datetime.now():%H:%M:%S}  {line}", err=True)
