"""Commands with many options: help in groups, recipes (files with options), and the command line of a call."""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import yaml
from click.core import ParameterSource

from beamline.cli.options import Declared, Decorator, name_of
from beamline.cli.options import option as declared_option
from beamline.core.files import SETTINGS, require_regular, text_in
from recon.base.registry import unknown

_RAW, _TYPED = "beamline.raw", "beamline.typed"
_PLAIN = re.compile(r"[\w.][\w.:,/+-]*(?<!:)")  # scalars that YAML writes without quotes


class Repeatable(click.Command):
    """A command that records its options in the form in which the user typed them."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta[_TYPED] = list(args)
        ctx.meta[_RAW] = self.make_parser(ctx).parse_args(args=list(args))[0]
        return super().parse_args(ctx, args)


def given(ctx: click.Context) -> dict[click.Option, Any]:
    """The options that the user gave on the command line or in a recipe, with the values as typed.

    A flag that a recipe switches off (`uncertainty: false`) counts as not given.
    """
    typed = {}
    for param in ctx.command.params:
        name = str(param.name)
        source = ctx.get_parameter_source(name)
        if not isinstance(param, click.Option) or (
            param.is_flag and not param.secondary_opts and not ctx.params.get(name)
        ):
            continue
        if source == ParameterSource.COMMANDLINE:
            typed[param] = ctx.meta[_RAW][name]
        elif source == ParameterSource.DEFAULT_MAP:
            typed[param] = (ctx.default_map or {})[name]
    return typed


def names_given(ctx: click.Context) -> set[str]:
    """The long names of the options that the user gave."""
    return {name_of(option) for option in given(ctx)}


def names_of_recipe(ctx: click.Context) -> set[str]:
    """The long names of the options that only a recipe gave."""
    sources = {option: ctx.get_parameter_source(str(option.name)) for option in given(ctx)}
    return {name_of(option) for option, source in sources.items() if source == ParameterSource.DEFAULT_MAP}


def _is_of_one_call(option: click.Option) -> bool:
    return isinstance(option, Declared) and option.of_one_call


def recipe_text(ctx: click.Context, method: str) -> str:
    """The recipe of this call as YAML. It has the method, and the given options that are not specific to one scan."""
    values = {
        name_of(option): _recipe_value(option, value)
        for option, value in given(ctx).items()
        if not _is_of_one_call(option)
    }
    return "".join(f"{name}: {_scalar(value)}\n" for name, value in ({"method": method} | values).items())


def _recipe_value(option: click.Option, value: Any) -> Any:
    """The value of an option as a recipe states it. Values of a repeatable option are separated by spaces."""
    if option.multiple:
        return " ".join(value)
    return os.path.realpath(value) if isinstance(option.type, click.Path) else value


def _scalar(value: Any) -> str:
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return text if _PLAIN.fullmatch(text) else json.dumps(text, allow_nan=False)


def typed_line(ctx: click.Context) -> str:
    """The command line of this call, as it was typed."""
    return shlex.join(["beamline", str(ctx.info_name), *ctx.meta[_TYPED]])


def config_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add --config: a recipe whose options apply unless the command line overrides them."""
    return declared_option(
        "--config",
        of_one_call=True,
        type=click.Path(path_type=Path),
        is_eager=True,
        expose_value=False,
        callback=_take,
        help="Recipe: a YAML file with options by their long names, as --write-config writes it. If you give a "
        "volume instead, the options that made this volume are used again. Options on the command line "
        "override the recipe.",
    )(command)


_ALLOWED_IN_RECIPES = ("angles", "angle-rows", "darks", "flats", "scanner-file", "cluster")
"""Options that belong to one call, but are allowed in a recipe. In a recipe they apply to all scans of a batch."""


def _take(ctx: click.Context, param: click.Parameter, value: Path | None) -> None:
    if value is None:
        return
    options = {
        name_of(option): option
        for option in ctx.command.params
        if isinstance(option, click.Option) and (not _is_of_one_call(option) or name_of(option) in _ALLOWED_IN_RECIPES)
    }
    former = {
        option.former.lstrip("-"): option
        for option in options.values()
        if isinstance(option, Declared) and option.former
    }
    defaults: dict[str, Any] = {}
    for name, text in _read(value).items():
        if name not in options and name not in former:
            raise click.BadParameter(f"{value}: {unknown('option of a recipe', name, options)}")
        if not isinstance(text, str) or not text:
            raise click.BadParameter(f"{value}: {name} must have a single value, as on the command line")
        option = options[name] if name in options else former[name]
        defaults[str(option.name)] = text.split() if option.multiple else text
    ctx.default_map = defaults


def _read(path: Path) -> Mapping[str, Any]:
    """The content of a recipe, with all values as text, because YAML would turn 61:04 into 3664."""
    try:
        text = _text(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise click.BadParameter(f"{path} cannot be read ({reason})") from error
    from beamline.config.tree import yaml_faults  # imported here because it loads pydantic

    with yaml_faults(text, str(path)):
        content = yaml.load(text, Loader=yaml.BaseLoader)  # noqa: S506 - builds text, lists and mappings only
    if not isinstance(content, dict):
        raise click.BadParameter(f"{path} is not a recipe; expected lines such as method: fbp")
    return content


def _text(path: Path) -> str:
    require_regular(path)
    with path.open("rb") as file:
        if file.read(4) != b"\x89HDF":
            return text_in(path, SETTINGS)
    from beamline.storage.writers.recon_file import opened_reconstruction

    with opened_reconstruction(path) as record:
        if "recipe" not in record.parameters:
            raise click.BadParameter(f"{path} contains no recipe; expected a volume written by `beamline recon`")
        return str(record.parameters["recipe"])


DATA = "Data"
CORRECTIONS = "Corrections"
METHOD = "Method"
OUTPUT = "Output"
RESOURCES = "Resources"
GROUPS = (DATA, CORRECTIONS, METHOD, OUTPUT, RESOURCES)
"""Headings of `--help-all`, in the order in which they are shown."""

_GROUP = "splatline_group"
_ALL = "splatline_help_all"


def heading(group: str) -> Decorator:
    """A decorator that puts the options below it, down to the next heading, into a group of the help.

    Args:
        group: one of GROUPS.
    """

    def mark(command: Callable[..., Any]) -> Callable[..., Any]:
        for param in getattr(command, "__click_params__", ()):
            if not hasattr(param, _GROUP):
                setattr(param, _GROUP, group)
        return command

    return mark


class Grouped(Repeatable):
    """A command whose options are shown in groups.

    Args:
        first: names of the parameters that `--help` shows, in this order.
    """

    def __init__(self, *args: Any, first: Sequence[str], **kwargs: Any) -> None:
        super().__init__(*args, **{"context_settings": {"help_option_names": ["-h", "--help"]}, **kwargs})
        self.first = tuple(first)
        self._help_all = click.Option(
            ["--help-all"], is_flag=True, is_eager=True, expose_value=False, callback=_show_all,
            help=f"Show all {len(self.grouped())} options, in groups.",
        )  # fmt: skip

    def grouped(self) -> list[click.Option]:
        """The options of the command, without hidden ones."""
        return [param for param in self.params if isinstance(param, click.Option) and not param.hidden]

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        return [*super().get_params(ctx), self._help_all]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        helps = [option for option in (self._help_all, self.get_help_option(ctx)) if option is not None]
        if not ctx.meta.get(_ALL):
            by_name = {option.name: option for option in self.grouped()}
            # without the feature, its option does not exist
            first = [by_name[name] for name in self.first if name in by_name]
            _section("Options", first + helps, ctx, formatter)
            return
        for group in (*GROUPS, None):
            options = [option for option in self.grouped() if getattr(option, _GROUP, None) == group]
            _section(group or "Help", options + (helps if group is None else []), ctx, formatter)


def _section(title: str, options: Sequence[click.Option], ctx: click.Context, formatter: click.HelpFormatter) -> None:
    if rows := [row for option in options if (row := option.get_help_record(ctx)) is not None]:
        with formatter.section(title):
            formatter.write_dl(rows)


def _show_all(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        ctx.meta[_ALL] = True
        click.echo(ctx.get_help())
        ctx.exit()
