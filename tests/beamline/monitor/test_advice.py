"""Every command, option and key of the configuration in the monitor's advice exists, and takes its value."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

import beamline
from beamline.cli.main import main
from beamline.config.load import config_folder, load
from beamline.monitor.checks import CHECKS

PACKAGE = Path(beamline.__file__).parent
PLACES = [
    *sorted((PACKAGE / "monitor").glob("*.py")),
    *(
        PACKAGE / part
        for part in (
            "scan/references.py",
            "scan/recorder.py",
            "scan/frame_checks.py",
            "scan/flagged.py",
            "scan/retakes.py",
            "scan/measurement.py",
            "cli/monitor.py",
        )
    ),
    *(PACKAGE / part for part in ("projections/replay.py", "reconstruct/scan_facts.py", "storage/rules/light.py")),
]
VALUES = {"N": "3", "VOLUME": "volume.h5", "FILE": "scan.h5", "SECONDS": "30"}
SECTIONS = "scan|monitor|storage|devices|references|optics"
KEY = re.compile(rf"(?<![\w./-])((?:{SECTIONS})(?:\.[a-z_]+)+)(?:(?:=|: ?)(\[\w+\]|\w+))?")
OPTION = re.compile(r"\((--[a-z-]+)(?: [a-z]+)?\)|with (--[a-z-]+)")


def texts(path: Path) -> Iterator[str]:
    """String constants that are no docstrings; what is filled in becomes the name of a check."""
    tree = ast.parse(path.read_text())
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    inner = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(part.value if isinstance(part, ast.Constant) else "..." for part in node.values)  # type: ignore[misc]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings | inner:
            yield node.value


ADVICE = [(path.name, text) for path in PLACES for text in texts(path) if " " in text]
COMMANDS = sorted({said for _, text in ADVICE for said in re.findall(r"`beamline ([^`]+)`", text)})
KEYS = sorted({said for _, text in ADVICE for said in KEY.findall(text)})
OPTIONS = sorted({option for _, text in ADVICE for found in OPTION.findall(text) for option in found if option})


@pytest.mark.parametrize("said", COMMANDS)
def test_a_command_exists_with_its_options_and_their_values(said: str) -> None:
    name, *words = said.split()
    context = click.Context(main)
    command = main.get_command(context, name)
    assert command is not None, f"there is no `beamline {name}`"
    words = ["scan.h5"] if words == ["..."] else [VALUES.get(word, word) for word in words]
    if words and words[-1].startswith("--"):  # named without a value
        assert any(words.pop() in option.opts for option in command.params)
    if any(isinstance(each, click.Argument) and each.required for each in command.params) and "scan.h5" not in words:
        words.append("scan.h5")
    with command.make_context(name, words, parent=context):
        pass


@pytest.mark.parametrize("option", OPTIONS)
def test_an_option_beside_a_command_is_one_of_recon(option: str) -> None:
    command = main.get_command(click.Context(main), "recon")
    assert command is not None and any(option in each.opts for each in command.params)


@pytest.mark.parametrize(("key", "value"), KEYS)
def test_a_key_of_the_configuration_exists_and_takes_its_value(key: str, value: str) -> None:
    config = load(config_folder() / "simulated.yaml", [f"{key}={value}"] if value else [], environment={})
    section = config
    for part in key.split("."):
        section = getattr(section, part)


@pytest.mark.parametrize("check", [check.name for check in CHECKS])
def test_every_check_may_be_named_for_views_that_are_taken_again(check: str) -> None:
    config = load(config_folder() / "simulated.yaml", [f"monitor.retake=[{check}]"], environment={})
    assert config.monitor.retaken_warnings == {check}
