"""Each command line in the pages uses existing commands, options and arguments."""

from __future__ import annotations

import inspect
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from beamline.cli.main import main, own_commands
from recon.base.registry import ADD_ONS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
_END = re.compile(r"\s+(#|&&|\|\|?|>|2>|<|;)\s.*|\s*[&;]$")  # a comment, or another command


def lines_of(page: Path) -> Iterator[str]:
    """Command lines in the fenced blocks of a page, and those in its running text that have more than a name."""
    text = page.read_text(encoding="utf-8")
    for block in re.findall(r"(?s)```\n(.*?)```", text):
        yield from re.findall(r"^(?:\$ )?beamline \w.*", block.replace("\\\n", " "), flags=re.M)
    yield from re.findall(r"`(beamline \w+ [^`\n]+)`", re.sub(r"(?s)```.*?```", "", text))


def whole(line: str) -> bool:
    """A line that can be typed: none with optional parts, of an add-on, or that only names an option."""
    return not re.search(r"\.\.\.|\[|\(splatline-|^beamline \w+ --[\w-]+$", line)


def refusal(line: str) -> str:
    """What the parser of the command says against a line; empty: nothing."""
    words = shlex.split(_END.sub("", line.removeprefix("$ ")))[1:]
    command: click.Command | None = main
    context = click.Context(main, info_name="beamline")
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        n = 2 if " ".join(words[:2]) in ADD_ONS else 1
        name, words = " ".join(words[:n]), words[n:]
        command = command.get_command(context, name)
        if command is None:
            return "" if name in ADD_ONS else f"no command {name}"
        context = click.Context(command, context, info_name=name, **command.context_settings)
    assert command is not None
    if command.name == "sweep":  # its options are those of recon
        words = [word for word in words if not re.fullmatch(r"[a-z-]+=.*", word)]
        return refusal(shlex.join(["beamline", "recon", *words]))
    try:
        values, rest, _ = command.make_parser(context).parse_args(list(words))
    except click.UsageError as error:
        return error.format_message()
    lacking = [each.name for each in command.params if each.required and values.get(str(each.name)) is None]
    return f"too many words: {rest}" if rest and not isinstance(command, click.Group) else ", ".join(map(str, lacking))


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_command_lines_of_a_page_are_accepted(page: Path) -> None:
    assert not {line: said for line in lines_of(page) if whole(line) and (said := refusal(line))}


@pytest.mark.parametrize("name", own_commands())
def test_the_examples_in_the_help_of_a_command_are_accepted(name: str) -> None:
    command = main.get_command(click.Context(main), name)
    assert command is not None
    lines = [line.split("    ")[0].strip() for line in inspect.cleandoc(command.help or "").splitlines()]
    examples = [line for line in lines if line.startswith("beamline ")]
    assert examples
    assert not {line: told for line in examples if (told := refusal(line))}


def test_a_wrong_line_is_found() -> None:
    assert refusal("beamline export V.h5 V.zarr") and refusal("beamline recon --no-such V.h5") and refusal("beamline x")
    assert not refusal("beamline export V.h5 -o V.zarr  # a comment")
