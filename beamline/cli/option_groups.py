"""Options under headings: `--help` shows those that a user needs first, `--help-all` shows all of them in groups."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import click

from beamline.cli.options import Decorator
from beamline.cli.recipe import Repeatable

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
    """A decorator that puts the options below it into a group, down to the next heading.

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
    """A command with many options. Each of them has a group.

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
        """The command's own options, without hidden ones."""
        return [param for param in self.params if isinstance(param, click.Option) and not param.hidden]

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        return [*super().get_params(ctx), self._help_all]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        helps = [option for option in (self._help_all, self.get_help_option(ctx)) if option is not None]
        if not ctx.meta.get(_ALL):
            by_name = {option.name: option for option in self.grouped()}
            first = [by_name[name] for name in self.first if name in by_name]  # a feature's option goes with it
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
