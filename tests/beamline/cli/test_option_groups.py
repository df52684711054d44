"""Commands with many options: ten of them in `--help`, all of them under five headings in `--help-all`."""

import io
import re
import subprocess
import sys

import click
import pytest
from click.testing import CliRunner

from beamline.cli.main import main, own_commands
from beamline.cli.recipe import GROUPS, Grouped
from beamline.cli.terminal import Terminal
from beamline.core.process import with_our_path
from beamline.core.recon_events import FitReached

CONTEXT = click.Context(main)
COMMANDS = {name: command for name in own_commands() if (command := main.get_command(CONTEXT, name))}
GROUPED = {name: command for name, command in COMMANDS.items() if isinstance(command, Grouped)}


def shown(*words: str) -> str:
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    return done.stdout


def names(text: str) -> list[str]:
    """The options that a help text lists, by their long names; what stands before the lists is left out."""
    _, head, lists = text.rpartition("Usage:")
    start = re.search(r"^\w[\w ]*:$", lists, flags=re.M) if head else None
    return re.findall(r"^  (?:-\w, )?(--[\w-]+)", lists[start.start() if start else 0 :], flags=re.M)


@pytest.mark.parametrize("name", GROUPED)
def test_help_shows_ten_options_and_where_the_others_are(name: str) -> None:
    assert len(set(names(shown(name, "--help")))) == 12
    assert names(shown(name, "-h"))[10:] == ["--help-all", "--help"]


@pytest.mark.parametrize("name", GROUPED)
def test_help_all_shows_every_option_once_under_its_heading(name: str) -> None:
    text = shown(name, "--help-all")
    options = [max(option.opts, key=len) for option in GROUPED[name].grouped()]
    assert sorted(names(text)) == sorted([*options, "--help-all", "--help"])
    headings = re.findall(r"^(\w[\w ]*):$", text, flags=re.M)
    assert headings == [group for group in (*GROUPS, "Help") if group in headings]
    assert names(text.split("\nHelp:\n")[1]) == ["--help-all", "--help"]
    assert f"all {len(options)} options" in text


CPU = """
import os, sys
from click.testing import CliRunner
from beamline.cli.main import main
assert CliRunner().invoke(main, [sys.argv[1], "--help"]).exit_code == 0
print(sum(os.times()[:2]))
"""


@pytest.mark.slow
def test_help_costs_little_processor_time() -> None:
    """Half a second on a free processor; a shared one counts up to half as much again."""
    words = [sys.executable, "-c", CPU, "recon"]
    runs = [subprocess.run(words, capture_output=True, text=True, env=with_our_path(), check=True) for _ in range(3)]
    assert min(float(run.stdout) for run in runs) < 0.75


@pytest.mark.parametrize(("no_color", "coloured"), [("1", False), ("", True)])
def test_no_color_is_respected(monkeypatch: pytest.MonkeyPatch, no_color: str, coloured: bool) -> None:
    monkeypatch.setenv("NO_COLOR", no_color)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    stream = io.StringIO()
    with Terminal(stream) as terminal:
        terminal(FitReached("recon", 5, 9, 1.0, 0.1, 0.1, 2, 4, None, "", None, None))
    assert bool(re.search(r"\x1b\[[\d;]*(?:3\d|9\d|38;5;\d+)m", stream.getvalue())) == coloured
