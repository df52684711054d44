"""`beamline man`, `completion`: the manual page of a command, made of its help, and the script for a shell."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from inspect import cleandoc
from textwrap import dedent

import click
from click.shell_completion import get_completion_class

from beamline.cli.options import NameChoice
from beamline.core.shipped import version

_WHOLE = "\b"  # click's mark of a paragraph whose lines stay as they are


@click.command()
@click.argument("command", required=False)
@click.pass_context
def man(ctx: click.Context, command: str | None) -> None:
    """Print the manual page of COMMAND, or of beamline itself, for man(1).

    To read one: beamline man scan | man -l -
    """
    root = ctx.find_root()
    assert isinstance(root.command, click.Group)
    page = root.command if command is None else root.command.get_command(root, command)
    if page is None:
        raise click.UsageError(f"There is no command {command}; `beamline --help` lists them.")
    described = root if command is None else click.Context(page, info_name=command, parent=root)
    codes = dedent((root.command.epilog or "").partition("Exit codes:\n")[2])
    click.echo("\n".join(_page(described, codes)))


def _page(ctx: click.Context, codes: str) -> Iterator[str]:
    """Lines in the language of man(7)."""
    command, name = ctx.command, ctx.command_path.replace(" ", "-")
    description = cleandoc(command.help or "")
    yield f'.TH "{_text(name.upper())}" 1 "" "splatline {_text(version())}"'
    yield ".ad l"
    yield from (".SH NAME", f"{_text(name)} \\- {_text(' '.join(description.partition(chr(10) * 2)[0].split()))}")
    yield from (".SH SYNOPSIS", f".B {_text(ctx.command_path)}", _text(" ".join(command.collect_usage_pieces(ctx))))
    yield ".SH DESCRIPTION"
    for paragraph in description.split("\n\n"):
        yield from _paragraph(paragraph)
    options = (param.get_help_record(ctx) for param in command.get_params(ctx) if isinstance(param, click.Option))
    yield from (".SH OPTIONS", *_list(record for record in options if record is not None))
    if isinstance(command, click.Group):
        parts = ((each, command.get_command(ctx, each)) for each in command.list_commands(ctx))
        yield ".SH COMMANDS"
        yield from _list((each, part.get_short_help_str(1000)) for each, part in parts if part is not None)
    yield from (".SH EXIT STATUS", *_paragraph(_WHOLE + codes))
    yield from (".SH ENVIRONMENT", *_list([("NO_COLOR", "Output without colours."), ("BEAMLINE_DEBUG", "As --debug.")]))


def _paragraph(text: str) -> Iterator[str]:
    if text.startswith(_WHOLE):
        yield from (".PP", ".nf", *map(_text, text.removeprefix(_WHOLE).strip("\n").splitlines()), ".fi")
    else:
        yield from (".PP", _text(" ".join(text.split())))


def _list(entries: Iterable[tuple[str, str]]) -> Iterator[str]:
    for name, text in entries:
        yield from (".TP", f".B {_text(name)}", _text(" ".join(text.split())))


def _text(text: str) -> str:
    """Text in which nothing is a request or an escape; a list of choices may break after each."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-").replace('"', "\\(dq").replace("|", "|\\:")
    return f"\\&{escaped}" if escaped.startswith((".", "'")) else escaped


@click.command()
@click.argument("shell", type=NameChoice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print the completion script of SHELL, which its start file evaluates (docs/commands.md)."""
    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(ctx.find_root().command, {}, "beamline", "_BEAMLINE_COMPLETE").source())
