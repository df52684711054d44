"""Files in the working folder with names of our or Python's modules are not imported by any of our processes."""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from beamline.config.load import config_folder, load, resolved_yaml
from beamline.core.files import CONFIG
from beamline.core.process import ChildProcess, ProcessEnd, with_our_path
from beamline.scan.watchdog import watched

OURS = ("beamline", "drivers", "recon", "simulators")
TAKEN = {*sys.stdlib_module_names} - {*sys.builtin_module_names} | {*OURS, "numpy", "h5py", "serial", "yaml"}


@pytest.fixture
def executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """Which of the files in the working folder, one for each name, were executed."""
    folder, marks = tmp_path / "work", tmp_path / "marks"
    folder.mkdir()
    marks.mkdir()
    for name in TAKEN:
        (folder / f"{name}.py").write_text(f"open({str(marks / name)!r}, 'w')\nraise ImportError('not ours')\n")
    monkeypatch.chdir(folder)
    return lambda: sorted(mark.name for mark in marks.iterdir())


def said(command: Sequence[str], folder: Path, environment: dict[str, str] | None = None) -> str:
    lines: list[str] = []
    with (
        (folder / "stderr").open("w") as stderr,
        ChildProcess(command, stderr, lines.append, environment, tether=True) as process,
    ):
        assert process.wait() is ProcessEnd.EXITED
    return "".join(lines) + (folder / "stderr").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_watchdog_starts(tmp_path: Path, executed: Callable[[], list[str]]) -> None:
    (tmp_path / CONFIG).write_text(resolved_yaml(load(config_folder() / "instrument.yaml", (), {})))
    told: list[str] = []
    with watched(tmp_path, lambda event: told.append(event.event)):
        pass
    assert (told, executed()) == ([], [])


@pytest.mark.slow
def test_what_they_start_is_as_safe(tmp_path: Path, executed: Callable[[], list[str]]) -> None:
    spawns = (
        "import multiprocessing as m, recon; p = m.get_context('spawn').Process(target=print, args=(recon.__file__,))"
    )
    text = said([sys.executable, "-c", f"{spawns}; p.start(); p.join(); print(p.exitcode)"], tmp_path)
    assert "__init__.py" in text and text.strip().endswith("0") and executed() == []


def test_the_path_of_a_child_is_without_the_working_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """`python -m` puts it there; who names it in PYTHONPATH wants it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setenv("PYTHONPATH", "")
    assert str(tmp_path) not in with_our_path()["PYTHONPATH"].split(os.pathsep)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert str(tmp_path) in with_our_path()["PYTHONPATH"].split(os.pathsep)
