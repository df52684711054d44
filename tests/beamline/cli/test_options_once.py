"""An option of a reconstruction is the same on the command line, in a recipe and in Python, with what it excludes."""

from dataclasses import fields
from pathlib import Path

import pytest
from click.testing import CliRunner

from beamline.cli.method_options import SLABS_RESUMED, takers
from beamline.cli.options import declared
from beamline.cli.recon import recon
from beamline.projections.selection import Selection
from beamline.reconstruct.options import ReconOptions
from recon.base.method import Traits
from recon.methods import taking

OPTIONS = declared(recon)
TYPED = {
    "steps": "5", "seconds": "5", "budget": "30s", "quality": "best", "gaussians": "9", "start": "tv", "loss": "l2",
    "kernel": "gaussian", "device": "cuda", "early-stop": "", "finish": "2", "checkpoint": "c.h5", "resume": __file__,
    "iterations": "3", "tv-weight": "0.1", "patch-threshold": "0.1", "allow-negative": "", "time": "3", "moves": "",
    "plain-splatting": "", "uncertainty": "", "truth": "t.npy", "follow": "", "earlier": "e.h5",
    "unfinished": "", "memory": "8G", "cluster": "local:1", "roi": "0:1,0:1,0:1",
    "dry-run": "",
}  # fmt: skip
"""A value of each option that has a rule; "" of a flag."""
PAIRS = [(name, other) for name, param in OPTIONS.items() for other in param.excludes if other != SLABS_RESUMED]
LACKING = [(name, param.needs[1]) for name, param in OPTIONS.items() if param.needs is not None]
OF_METHODS = [name for name, param in OPTIONS.items() if param.setting or param.trait]


def words(name: str) -> list[str]:
    value = TYPED[name]
    return [f"--{name}", value] if value else [f"--{name}"]


def refusal(*arguments: str) -> str:
    done = CliRunner().invoke(recon, ["no_scan.h5", *arguments])
    assert done.exit_code == 2, done.output
    return done.output.partition("Error: ")[2].strip()


@pytest.mark.parametrize("name", OPTIONS)
def test_a_rule_names_what_is_there(name: str) -> None:
    param = OPTIONS[name]
    assert not param.setting or taking(param.setting)
    assert not param.trait or param.trait in {each.name for each in fields(Traits)}
    assert set(param.excludes) | ({param.needs[0]} if param.needs else set()) <= {*OPTIONS, SLABS_RESUMED}


@pytest.mark.parametrize(("name", "other"), PAIRS)
def test_a_contradiction_is_refused_on_the_command_line_and_in_a_recipe(name: str, other: str, tmp_path: Path) -> None:
    told = refusal(*words(name), *words(other))
    assert told.startswith(f"--{name} does not go with --{other}: {OPTIONS[name].excludes[other]}.")
    both = [OPTIONS[each] for each in (name, other)]
    if not any(param.of_one_call for param in both):
        recipe = tmp_path / "recipe.yaml"
        recipe.write_text("".join(f"{each}: {TYPED[each] or 'true'}\n" for each in (name, other)))
        assert refusal("--config", str(recipe)) == told


@pytest.mark.parametrize(("name", "end"), LACKING)
def test_what_an_option_needs_is_told_alike(name: str, end: str) -> None:
    assert refusal(*words(name)) == f"--{name} {end}"


@pytest.mark.parametrize("name", [name for name in OF_METHODS if not OPTIONS[name].needs])
def test_an_option_of_other_methods_is_refused(name: str) -> None:
    told = refusal("-m", "fbp", *words(name))
    assert told == f"--{name} is of {', '.join(takers(OPTIONS[name]))}; it does not go with --method fbp."


def test_defaults_of_the_command_are_those_of_python() -> None:
    """An option that nobody gave leaves the value that Python has."""
    context = recon.make_context("recon", ["no_scan.h5"])
    shared = [
        each
        for each in fields(ReconOptions)
        if each.name in context.params and each.name not in ("follow", "method", "target")
    ]
    assert len(shared) == 11
    for each in shared:
        assert (context.params[each.name] or None) == (each.default or None), each.name
    for name in ("views", "rows", "binning", "cone"):
        assert context.params[name] == getattr(Selection(), name), name
