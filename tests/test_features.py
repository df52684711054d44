"""Features are folders and modules that can be removed: the core runs without each one, and without all."""

import itertools
import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from beamline.cli.main import CORE, feature_commands
from tests.features import PACKAGES, ROOT, folders, table

_LOADS = """
import sys

import click

from beamline.cli.main import main
from beamline.instrument.connect import connect
from beamline.instrument.simulated import WIRES

context = click.Context(main)
commands = {name: main.get_command(context, name) for name in main.list_commands(context)}
assert set(sys.argv[1:]) <= set(commands)
for name in commands:
    main([name, "--help"], standalone_mode=False)
main(["--help"])
"""
_FORKS = """
import json, os, sys, traceback

import click, h5py, numpy, pydantic, rich.console, yaml  # once, not by each fork

parts, loads = json.loads(sys.argv[1]), sys.argv[2]
del sys.argv[1:3]
for part, paths in parts.items():
    for n, path in enumerate(paths):
        os.rename(path, f"aside/{n}")
    if not (child := os.fork()):
        page = os.open(f"aside/{part}.txt", os.O_CREAT | os.O_WRONLY)
        os.dup2(page, 1), os.dup2(page, 2)
        try:
            exec(loads)
        except SystemExit:
            pass
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(0)
    os.waitpid(child, 0)
    for n, path in enumerate(paths):
        os.rename(f"aside/{n}", path)
"""
"""Runs its second argument in a fork for each part of the features, without that; each writes to a file."""
_METHODS = "import recon\nfor entry in recon.methods.REGISTRY.values(): getattr(recon, entry.cls)()"
_QUICK = (
    "tests/beamline/plan", "tests/beamline/simulate", "tests/recon/assess", "tests/recon/base/test_geometry.py",
    "tests/recon/base/test_registry.py", "tests/simulators/frame", "tests/simulators/pixels",
)  # fmt: skip
"""Tests of the core that use no feature."""
_SCAN = (
    "monitor={}",
    "scan.angles.views=9",
    "scan.mode=step",
    "simulation.scene=scenes/ideal.yaml",
    "simulation.clock=virtual",
)
"""Of the simulated configuration, with the checks of the core."""


PARENTS = (
    "beamline/config/families", "beamline/features", "beamline/monitor", "beamline/projections/corrections",
    "beamline/storage/readers", "beamline/storage/volumes", "drivers/stages", "recon/features", "simulators/effects",
    "simulators/samples/builders", "simulators/wires",
)  # fmt: skip
"""Registries look for features in the folders of these."""


def test_each_folder_of_features_is_in_the_table() -> None:
    within = [
        path.parent.relative_to(ROOT).as_posix() for parent in PARENTS for path in (ROOT / parent).glob("*/__init__.py")
    ]
    named = [folder for own in table().values() for folder in own]
    assert len(named) == len(set(named))
    assert not [folder for folder in named if not (ROOT / folder).exists()]
    assert set(within) <= set(named)


def test_a_newcomer_sees_the_commands_of_the_core_first_and_no_more_than_22() -> None:
    assert len(CORE) <= 22


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what the features live in."""
    root = tmp_path_factory.mktemp("copy")
    ignored = shutil.ignore_patterns("__pycache__", "*.npz", ".*cache")
    for folder in (*PACKAGES, "configs", "tests"):
        shutil.copytree(ROOT / folder, root / folder, ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", root)
    return root


@contextmanager
def _without(features: list[str], root: Path) -> Iterator[None]:
    """The copy without these features' folders, which come back afterwards."""
    moved = [(path, root / "aside" / str(n)) for n, path in enumerate(p for f in features for p in folders(f, root))]
    (root / "aside").mkdir(exist_ok=True)
    for path, aside in moved:
        path.rename(aside)
    try:
        yield
    finally:
        for path, aside in moved:
            aside.rename(path)


def _run(root: Path, *words: str) -> str:
    ended = subprocess.run(
        [sys.executable, *words], cwd=root, env=_environment(root), capture_output=True, text=True, timeout=200,
        check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout[-3000:] + ended.stderr[-3000:]
    return ended.stdout


def _environment(root: Path) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(root)}


def parts_that_tell_apart(names: Sequence[str]) -> list[list[str]]:
    """Sets of names, such that for any two names some set holds the first without the second.

    Each name has a code of its own, half of some digits; the names with a digit are a set. No code is within another,
    as all have equally many digits (Sperner, 1928).
    """
    digits = next(n for n in itertools.count(1) if math.comb(n, n // 2) >= len(names))
    codes = itertools.combinations(range(digits), digits // 2)
    of_each = dict(zip(names, codes, strict=False))
    return [[name for name, code in of_each.items() if digit in code] for digit in range(digits)]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="each part has a fork of one process")
def test_the_core_loads_without_any_one_feature_and_none_needs_another(copied: Path) -> None:
    """Some features are removed at once, so that each is seen to load without any other one."""
    (copied / "aside").mkdir(exist_ok=True)
    parts = parts_that_tell_apart([name for name in table() if name != "shared"])
    for one, other in itertools.permutations(set(table()) - {"shared"}, 2):
        assert any(one in part and other not in part for part in parts)
    named = {
        str(n): [str(path.relative_to(copied)) for name in part for path in folders(name, copied)]
        for n, part in enumerate(parts)
    }
    _run(copied, "-c", _FORKS, json.dumps(named), _LOADS, *CORE)
    for n, part in enumerate(parts):
        help_page = (copied / "aside" / f"{n}.txt").read_text(encoding="utf-8")
        assert all(f"\n  {command} " in help_page for command in CORE), f"without {part}:\n{help_page[-3000:]}"


@pytest.mark.slow
def test_the_core_keeps_its_contracts_and_passes_its_quick_tests_without_any(copied: Path) -> None:
    contracts = copied / "pyproject.toml"
    text = contracts.read_text(encoding="utf-8")
    for path in (path for own in table().values() for path in own):  # a contract names only what is there
        text = text.replace(f'"{path.removesuffix(".py").replace("/", ".")}",', "")
    contracts.write_text(text, encoding="utf-8")
    with _without(list(table()), copied):
        page = _run(copied, "-c", _LOADS, *CORE).rpartition("Usage:")[2]
        listed = set(re.findall(r"^  ([\w-]+) ", page, re.MULTILINE))  # with those of add-ons that are installed
        assert listed >= set(CORE) and not listed & set(feature_commands())
        _run(copied, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()", "--no-cache")
        _run(copied, "-c", _METHODS)
        # an add-on that is installed may need a feature
        left_out = "filterwarnings=error\nignore:The .* was left out:UserWarning"
        _run(copied, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-o", left_out, *_QUICK)


@pytest.mark.slow
def test_the_core_scans_with_one_family_of_stages(copied: Path) -> None:
    settings = (word for setting in _SCAN for word in ("--set", setting))
    with _without([name for name in table() if name not in ("pm16c", "shared")], copied):
        _run(copied, "-m", "beamline.cli.main", "scan", "configs/simulated.yaml", "--no-live", *settings)
