"""Add-ons in packages/ use only public names of splatline; the name of a missing one says what to install."""

import ast
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

import recon
from beamline import api
from beamline.cli.main import main
from beamline.core.errors import ConfigError
from beamline.reconstruct.memory import cluster
from recon.base.registry import ADD_ONS, Registry, UnknownNameError
from tests.public_names import FOR_BLUESKY, FOR_PACKAGES

ROOT = Path(__file__).parents[1]
FOLDERS = sorted(path.parent for path in ROOT.glob("packages/*/pyproject.toml"))
PUBLIC = {"recon": recon.__all__, "beamline.api": api.__all__, **FOR_BLUESKY, **FOR_PACKAGES}
OURS = ("beamline", "recon", "drivers", "simulators")


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_an_add_on_imports_public_names_alone(folder: Path) -> None:
    private = set()
    for path in (folder / folder.name.replace("-", "_")).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in OURS:
                names = {alias.name for alias in node.names} - {*PUBLIC.get(str(node.module), ())}
                private |= {f"{path.name}: {node.module}.{name}" for name in names}
            elif isinstance(node, ast.Import):
                private |= {
                    each.name for each in node.names if each.name.startswith(tuple(f"{name}." for name in OURS))
                }
    assert not private


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_an_add_on_has_entry_points_that_say_what_to_install_without_it(folder: Path) -> None:
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["name"] == folder.name and (folder / "README.md").is_file()
    names = {name for points in project["entry-points"].values() for name in points}
    assert names <= {name for name, package in ADD_ONS.items() if package == folder.name}


def test_a_missing_add_on_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recon.base.registry.entry_points_announced", lambda: ())
    monkeypatch.setattr("beamline.cli.main.commands", dict)
    said = CliRunner().invoke(main, ["tango"]).stderr
    assert (
        "`beamline tango` is in a package that is not installed. Install it with: pip install splatline-tango." in said
    )
    said = CliRunner().invoke(main, ["study", "structure", "SCAN"]).stderr
    assert (
        "`beamline study structure` is in a package that is not installed. "
        "Install it with: pip install splatline-structure."
    ) in said
    with pytest.raises(
        ConfigError, match=r"--cluster is in a package that .* Install it with: pip install splatline-cluster"
    ):
        cluster("local:2")
    with pytest.raises(UnknownNameError, match="pip install splatline-tango"):
        Registry("method", {})["tango"]
