"""An option of a reconstruction is the same on the command line, in a recipe and in Python, with what it excludes."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from beamline.cli.options import declared, name_of, rules_of
from beamline.cli.recon import recon
from beamline.core.errors import ConfigError
from beamline.projections.registry import registered
from beamline.projections.selection import Selection
from beamline.projections.step import key_of, options_of
from beamline.reconstruct.checkpoints import CheckpointOptions
from beamline.reconstruct.option_rules import RULES, SLABS_RESUMED, OptionRule, takers
from beamline.reconstruct.options import FollowTiming, OutputPaths, ReconOptions
from beamline.reconstruct.region import Region
from beamline.storage.readers.open import SourceOptions
from recon.base.method import Method, Traits
from recon.methods import DEFAULT, build, by_name, has_setting
from recon.voxels.enough_views import Goal

OPTIONS = {name_of(param): param for param in declared(recon).values()}
TYPED = {
    "steps": "5", "seconds": "5", "budget": "30s", "quality": "best", "gaussians": "9", "start": "tv", "loss": "l2",
    "kernel": "gaussian", "device": "cuda", "early-stop": "", "finish": "2", "checkpoint": "c.h5", "resume": __file__,
    "iterations": "3", "tv-weight": "0.1", "patch-threshold": "0.1", "allow-negative": "", "time": "3", "moves": "",
    "plain-splatting": "", "uncertainty": "", "truth": "t.npy", "follow": "", "earlier": "e.h5", "enough-loss": "1",
    "enough-gain": "1", "unfinished": "", "memory": "8G", "cluster": "local:1", "roi": "0:1,0:1,0:1",
    "dry-run": "",
}  # fmt: skip
"""A value of each option that has a rule; "" of a flag."""
VALUES = {
    "steps": 5, "seconds": 5.0, "gaussians": 9, "start": "tv", "fit.loss": "l2", "fit.kernel": "gaussian",
    "early_stop": True, "finish": 2, "iterations": 3, "tv_weight": 0.1, "patch_threshold": 0.1, "allow_negative": True,
    "volumes": 3, "moves": True, "fit.rays.rectified": False, "budget": 30.0, "quality": "best", "device": "cuda",
    "checkpoints.path": CheckpointOptions(Path("c.h5")), "checkpoints.resume": CheckpointOptions(None, Path(__file__)),
    "uncertainty": True, "truth": "t.npy", "enough.psnr_loss": Goal(None, 1.0), "unfinished": True,
    "enough.psnr_gain_per_10_views": Goal(1.0), "memory": 8_000_000_000, "cluster": "local:1", "partial": Path("p.h5"),
    "region": Region((0, 1), (0, 1), (0, 1)), "follow": FollowTiming(),
}  # fmt: skip
"""The same in Python, by the path of the setting or of the value."""
PAIRS = [(name, other) for name, rule in RULES.items() for other in rule.excludes if SLABS_RESUMED not in (name, other)]
LACKING = [(name, rule.needs[1]) for name, rule in RULES.items() if rule.needs is not None]


def words(name: str) -> list[str]:
    value = TYPED[name]
    return [f"--{name}", value] if value else [f"--{name}"]


def refusal(*arguments: str) -> str:
    done = CliRunner().invoke(recon, ["no_scan.h5", *arguments])
    assert done.exit_code == 2, done.output
    return done.output.partition("Error: ")[2].strip()


def options(*names: str) -> ReconOptions:
    """Options of Python that say the same."""
    settings = {RULES[name].setting: VALUES[RULES[name].setting] for name in names if RULES[name].setting}
    needed = [takers(RULES[name]) for name in names if RULES[name].of_methods]
    method = next((each for each in (needed or [(DEFAULT,)])[0] if all(each in some for some in needed)), DEFAULT)
    fitting = by_name("r2" if method == "auto" else method)
    run = {rule.value.split(".")[0]: VALUES[rule.value] for name in names if (rule := RULES[name]).value}
    target = OutputPaths(Path("v.h5"), None)
    return ReconOptions(SourceOptions("no_scan.h5"), target, Selection(), build(fitting, settings), **run)


def test_each_option_is_a_value_in_python_or_of_one_call() -> None:
    """Of the job, the selection, the scan, a step or a method; the rest is of the command alone, and no recipe's."""
    steps = {key_of(each.name) for step in registered() for each in options_of(step).values()}
    renamed = {"axis": "axis_col", "pixel_size_um": "pixel_size_mm", "ramp": "filter"}
    python = steps | {each.name for kind in (ReconOptions, Selection, SourceOptions) for each in fields(kind)}
    alone = {
        name
        for name, param in OPTIONS.items()
        if name not in RULES and renamed.get(str(param.name), str(param.name)) not in python
    }
    of_a_call = {"config", "preset", "output", "report", "write-config", "log", "verbose", "beside-scan", "json"}
    assert alone == of_a_call | {"set", "max-residual"}
    assert {name for name in alone if not OPTIONS[name].of_one_call} == {"set", "max-residual"}


@pytest.mark.parametrize("name", RULES)
def test_a_rule_names_what_is_there(name: str) -> None:
    rule = RULES[name]
    assert name in OPTIONS or name == SLABS_RESUMED
    assert not rule.setting or any(has_setting(by_name(method), rule.setting) for method in takers(rule))
    assert not rule.trait or rule.trait in {each.name for each in fields(Traits)}
    if rule.value:
        first, *rest = rule.value.split(".")
        assert first in {each.name for each in fields(ReconOptions)}
        kind = {"checkpoints": CheckpointOptions, "enough": Goal}.get(first)
        assert not rest or (kind is not None and rest[0] in {each.name for each in fields(kind)})
    assert set(rule.excludes) | ({rule.needs[0]} if rule.needs else set()) <= {*OPTIONS, SLABS_RESUMED}


def test_the_command_has_the_rules_of_python_and_no_others() -> None:
    own = {name: rule for name, rule in rules_of(recon).items() if rule != OptionRule()}
    assert own == {name: rule for name, rule in RULES.items() if rule != OptionRule() and name != SLABS_RESUMED}


@pytest.mark.parametrize(("name", "other"), PAIRS)
def test_a_contradiction_is_told_alike_everywhere(name: str, other: str, tmp_path: Path) -> None:
    told = refusal(*words(name), *words(other))
    assert told.startswith(f"--{name} does not go with --{other}: {RULES[name].excludes[other]}.")
    both = [OPTIONS.get(each) for each in (name, other)]
    if all(param is not None and not param.of_one_call for param in both):
        recipe = tmp_path / "recipe.yaml"
        recipe.write_text("".join(f"{each}: {TYPED[each] or 'true'}\n" for each in (name, other)))
        assert refusal("--config", str(recipe)) == told
    there = [each for each in (name, other) if each in RULES and (RULES[each].value or RULES[each].setting)]
    if len(there) < 2 or all(RULES[each].setting for each in there):
        return  # the command alone has them, or one method both
    with pytest.raises(ConfigError) as refused:
        options(*there).refuse_contradictions()
    assert str(refused.value) == told


@pytest.mark.parametrize(("name", "end"), LACKING)
def test_what_an_option_needs_is_told_alike(name: str, end: str) -> None:
    assert refusal(*words(name)) == f"--{name} {end}"


@pytest.mark.parametrize("name", [name for name, rule in RULES.items() if rule.of_methods and not rule.needs])
def test_an_option_of_other_methods_is_told_alike(name: str) -> None:
    told = refusal("-m", "fbp", *words(name))
    assert told == f"--{name} is of {', '.join(takers(RULES[name]))}; it does not go with --method fbp."
    if not RULES[name].value:
        return  # a setting, which fbp has not in Python either
    run = {RULES[name].value.split(".")[0]: VALUES[RULES[name].value]}
    fbp = ReconOptions(SourceOptions("s.h5"), OutputPaths(Path("v.h5"), None), Selection(), by_name("fbp")(), **run)
    with pytest.raises(ConfigError) as refused:
        fbp.refuse_contradictions()
    assert str(refused.value) == told


@pytest.mark.parametrize("name", [name for name, rule in RULES.items() if rule.setting])
def test_methods_take_the_least_that_the_command_takes(name: str) -> None:
    kind: Any = OPTIONS[name].type
    least = getattr(kind, "min", None)
    if least is None or getattr(kind, "min_open", False):
        assert isinstance(kind, click.Choice | click.types.BoolParamType) or least is not None
        return
    for method in takers(RULES[name]):
        made: Method = build(by_name(method), {RULES[name].setting: least})
        assert made.name == method


def test_defaults_of_the_command_are_those_of_python() -> None:
    """An option that nobody gave leaves the value that Python has."""
    context = recon.make_context("recon", ["no_scan.h5"])
    run = {each.name: each.default for each in fields(ReconOptions)}
    shared = {rule.value for rule in RULES.values()} & context.params.keys() | {"filter", "seed"}
    assert len(shared) == 12
    for name in shared:
        assert (context.params[name] or None) == (run[name] or None), name
    for name in ("views", "rows", "binning", "cone"):
        assert context.params[name] == getattr(Selection(), name), name
