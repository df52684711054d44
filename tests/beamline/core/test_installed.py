"""Other modules by the names of our packages are reported in one line, before anything else is imported."""

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from beamline.core import installed

ROOT = Path(__file__).parents[3]


def run(script: Path, first: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(first), str(ROOT)])}
    return subprocess.run([sys.executable, script], capture_output=True, text=True, env=environment)


def test_here_all_are_ours() -> None:
    assert installed.package_problem(str(ROOT)) == ""


def test_a_script_of_the_user_by_the_name_of_a_package(tmp_path: Path) -> None:
    """As an ImportError for Python, and as one line for a command."""
    (tmp_path / "recon.py").write_text("print('mine')\n", encoding="utf-8")
    script = tmp_path / "study.py"
    script.write_text("import beamline.api\n", encoding="utf-8")
    command = tmp_path / "beamline"
    command.write_text("from beamline.cli.main import run\n", encoding="utf-8")
    told = run(script, tmp_path).stderr.splitlines()[-1]
    expected = f"Python finds 'recon' at {tmp_path / 'recon.py'}, not splatline's at {ROOT / 'recon/__init__.py'}"
    assert told == f"ImportError: {expected}: rename that one, or work in another folder."
    done = run(command, tmp_path)
    assert (done.stdout, done.stderr, done.returncode) == ("", told.removeprefix("ImportError: ") + "\n", 1)


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A site-packages with our packages and another distribution's package `drivers`."""
    site = tmp_path / "site-packages"
    for name in installed.OWN_PACKAGES:
        (site / name).mkdir(parents=True)
        text = '"""Motors."""\n' if name == "drivers" else '"""Of splatline."""\n'
        (site / name / "__init__.py").write_text(text, encoding="utf-8")
        module = ModuleType(name)
        module.__file__ = str(site / name / "__init__.py")
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(sys, "path", [str(site)])
    return site


def test_a_distribution_that_has_overwritten_a_package(environment: Path) -> None:
    told = installed.package_problem(str(environment))
    assert told.startswith(
        f"{environment / 'drivers/__init__.py'} is not splatline's: it belongs to another distribution"
    )
