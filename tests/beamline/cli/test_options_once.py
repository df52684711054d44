"""An option of a reconstruction is the same on the command line, in a recipe and in Python, with what it excludes.

`python -m tests.beamline.cli.test_options_once` records the words of all refusals anew; read their differences.
"""

import json
from dataclasses import fields
from pathlib import Path

import pytest
from click.testing import CliRunner

from beamline.cli.options import declared
from beamline.cli.recon import recon
from beamline.projections.selection import Selection
from beamline.reconstruct.combinations import SLABS_RESUMED
from beamline.reconstruct.options import ReconOptions
from recon.methods import accepting, taking

OPTIONS = declared(recon)
TYPED = {
    "steps": "5", "seconds": "5", "budget": "30s", "quality": "best", "gaussians": "9", "start": "tv", "loss": "l2",
    "kernel": "gaussian", "device": "cuda", "early-stop": "", "finish": "2", "checkpoint": "c.h5", "resume": __file__,
    "iterations": "3", "tv-weight": "0.1", "patch-threshold": "0.1", "levels": "0.1,0.5",
    "allow-negative": "", "reference": "g.h5", "volumes": "3", "moves": "",
    "plain-splatting": "", "uncertainty": "", "truth": "t.npy", "follow": "", "previous-part": "e.h5",
    "unfinished": "", "memory": "8G", "cluster": "local:1", "roi": "0:1,0:1,0:1",
    "dry-run": "",
}  # fmt: skip
"""A value of each option that has a rule; "" of a flag."""
PAIRS = [(name, other) for name, param in OPTIONS.items() for other in param.excludes if other != SLABS_RESUMED]
LACKING = [name for name, param in OPTIONS.items() if param.needs is not None]
OF_METHODS = [name for name, param in OPTIONS.items() if (param.setting or param.argument) and not param.needs]
GOLDEN = Path(__file__).with_name("refusals.json")
REFUSALS: dict[str, str] = json.loads(GOLDEN.read_text(encoding="utf-8")) if GOLDEN.is_file() else {}


def words(name: str) -> list[str]:
    value = TYPED[name]
    return [f"--{name}", value] if value else [f"--{name}"]


ASKED: dict[str, list[str]] = {
    **{f"--{name} --{other}": [*words(name), *words(other)] for name, other in PAIRS},
    **{f"--{name}": words(name) for name in LACKING},
    **{f"-m fbp --{name}": ["-m", "fbp", *words(name)] for name in OF_METHODS},
}
"""Every refusal, by a short form of what is asked."""


def refusal(*arguments: str) -> str:
    done = CliRunner().invoke(recon, ["no_scan.h5", *arguments])
    assert done.exit_code == 2, done.output
    return done.output.partition("Error: ")[2].strip()


@pytest.mark.parametrize("name", [name for name, param in OPTIONS.items() if param.former])
def test_the_name_of_the_last_version_is_understood_and_not_shown(name: str) -> None:
    now, before = (
        recon.make_context("recon", ["no_scan.h5", words, TYPED.get(name, "b.h5")])
        for words in (f"--{name}", OPTIONS[name].former)
    )
    assert now.params == before.params != recon.make_context("recon", ["no_scan.h5"]).params
    assert f"{OPTIONS[name].former} " not in now.get_help()


@pytest.mark.parametrize("name", OPTIONS)
def test_a_rule_names_what_is_there(name: str) -> None:
    param = OPTIONS[name]
    assert not param.setting or taking(param.setting)
    assert not param.argument or accepting(param.argument) or param.argument == "budget"
    assert set(param.excludes) | ({param.needs[0]} if param.needs else set()) <= {*OPTIONS, SLABS_RESUMED}


@pytest.mark.parametrize(("name", "other"), PAIRS)
def test_a_contradiction_is_refused_on_the_command_line_and_in_a_recipe(name: str, other: str, tmp_path: Path) -> None:
    told = refusal(*words(name), *words(other))
    assert told == REFUSALS[f"--{name} --{other}"]
    both = [OPTIONS[each] for each in (name, other)]
    if not any(param.of_one_call for param in both):
        recipe = tmp_path / "recipe.yaml"
        recipe.write_text("".join(f"{each}: {TYPED[each] or 'true'}\n" for each in (name, other)))
        assert refusal("--config", str(recipe)) == told


@pytest.mark.parametrize("name", LACKING)
def test_what_an_option_needs_is_told(name: str) -> None:
    assert refusal(*words(name)) == REFUSALS[f"--{name}"]


@pytest.mark.parametrize("name", OF_METHODS)
def test_an_option_of_other_methods_is_refused(name: str) -> None:
    told = refusal("-m", "fbp", *words(name))
    assert told == REFUSALS[f"-m fbp --{name}"]


def test_defaults_of_the_command_are_those_of_python() -> None:
    """An option that nobody gave leaves the value that Python has."""
    context = recon.make_context("recon", ["no_scan.h5"])
    shared = [
        each
        for each in fields(ReconOptions)
        if each.name in context.params and each.name not in ("follow", "method", "target")
    ]
    assert len(shared) == 12
    for each in shared:
        assert (context.params[each.name] or None) == (each.default or None), each.name
    for name in ("views", "rows", "binning", "cone"):
        assert context.params[name] == getattr(Selection(), name), name


def test_each_refusal_that_was_recorded_is_one_still() -> None:
    assert REFUSALS.keys() == ASKED.keys()


if __name__ == "__main__":
    said = {asked: refusal(*arguments) for asked, arguments in ASKED.items()}
    GOLDEN.write_text(json.dumps(said, indent=0) + "\n", encoding="utf-8")
