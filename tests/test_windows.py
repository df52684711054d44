"""What can be tried of Windows on Linux: consoles with a code page, files that nobody replaces or removes while they
are open, no `fork`, and processes by spawn.

Each command runs in a process whose `sitecustomize` takes away what Windows lacks. Paths, locks and signals stay those
of Linux (see `test_platforms`), and no file system here ignores the case of names.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from beamline.config.load import config_folder
from beamline.core.errors import DataError
from beamline.core.files import atomic_file

ROOT = Path(__file__).parents[1]
linux = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="which files are open is read from /proc")

AS_ON_WINDOWS = '''
import multiprocessing, os, pathlib, signal
for module, names in ((os, ("fork", "forkpty", "nice", "mkfifo", "setsid", "killpg")),
                      (signal, ("SIGUSR1", "SIGUSR2", "SIGHUP", "SIGTSTP", "SIGXCPU", "SIGALRM"))):
    for name in names:
        delattr(module, name)
multiprocessing.set_start_method("spawn")

def held(path):
    """Whether a process has the file open."""
    try:
        status = os.stat(path, follow_symlinks=False)
    except (OSError, TypeError):
        return False
    for process in filter(str.isdecimal, os.listdir("/proc")):
        try:
            for number in os.listdir(f"/proc/{process}/fd"):
                opened = os.stat(f"/proc/{process}/fd/{number}")
                if (opened.st_dev, opened.st_ino) == (status.st_dev, status.st_ino):
                    return True
        except OSError:
            continue
    return False

def guarded(call, of):
    def refuse(*paths, **more):
        for path in paths[:of]:
            if not more.get("dir_fd") and held(path):
                raise PermissionError(13, "The process cannot access the file because it is being used by another "
                                      "process", os.fspath(path))
        return call(*paths, **more)
    return refuse

for name, of in (("replace", 2), ("rename", 2), ("unlink", 1), ("remove", 1)):
    setattr(os, name, guarded(getattr(os, name), of))
'''


@pytest.fixture
def windows(tmp_path: Path) -> dict[str, str]:
    """The environment of a process as on Windows, with the code page of Western Europe."""
    place = tmp_path / "site"
    place.mkdir()
    (place / "sitecustomize.py").write_text(AS_ON_WINDOWS, encoding="utf-8")
    paths = os.pathsep.join((str(place), str(ROOT)))
    return {**os.environ, "PYTHONPATH": paths, "PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "0", "LC_ALL": "C"}


def ran(folder: Path, environment: dict[str, str], *words: str) -> str:
    command = [sys.executable, "-m", "beamline.cli.main", *words]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, timeout=220)
    text = (done.stdout + done.stderr).decode("cp1252")
    assert done.returncode == 0, text
    assert "Traceback" not in text and "UnicodeEncodeError" not in text
    return text


HELPS = """
import click
from beamline.cli.main import commands, guard_streams
guard_streams()
def show(command, name):
    context = click.Context(command, info_name=name)
    click.echo(command.get_help(context))
    for below in getattr(command, "commands", {}):
        show(command.get_command(context, below), f"{name} {below}")
for name, entry in commands().items():
    show(entry.load(name), name)
"""


@pytest.mark.parametrize("page", ["cp1252", "cp437", "cp932"])
def test_each_help_is_printed_in_a_code_page(page: str) -> None:
    """Of Western Europe, of an old console, and of Japan."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": page, "PYTHONUTF8": "0"}
    done = subprocess.run([sys.executable, "-c", HELPS], env=environment, capture_output=True, timeout=220)
    assert done.returncode == 0, done.stderr.decode(page, "replace")
    assert done.stdout.decode(page).count("Usage: ") > 30


SCENE = """{phantom: {kind: solids, solids: [
{kind: cylinder, radius: 0.05, height: 0.1, attenuation: 3.0},
{kind: ellipsoid, semi_axes: [0.02, 0.02, 0.02], attenuation: 8.0, centre: [0.02, 0.01, 0.0]}]},
beam: {photons_per_s: 1.0e+5}, effects: [photon_noise]}"""
SMALL = (
    f"simulation.scene={SCENE}", "simulation.clock={speed: 10.0}", "devices.camera.roi=[1140, 2032, 24, 32]",
    "scan.angles.views=24", "scan.period_s=0.3", "scan.darks.count=2", "scan.flats.count=2", "recon.seconds=1.5",
    "devices.stage.low_deg=-90",
)  # fmt: skip


@linux
def test_a_scan_is_simulated_reconstructed_and_exported(windows: dict[str, str], tmp_path: Path) -> None:
    small = ("--frames", "24", "--set", "detector.shape=[8,32]", "--set", "detector.pixel_size_um=20")
    ran(tmp_path, windows, "simulate", "plain", "-o", "scan.h5", *small)
    ran(tmp_path, windows, "recon", "scan.h5", "-m", "fbp", "-o", "volume.h5")
    ran(tmp_path, windows, "export", "volume.h5", "-o", "volume.tif")
    assert "reconstructable   yes" in ran(tmp_path, windows, "info", "scan.h5")
    left = {path.name for path in tmp_path.iterdir()} - {"site", "scan.h5", "scan.labels.json", "scan.png"}
    assert left == {"volume.h5", "volume.html", "volume.tif"}


@linux
@pytest.mark.slow
def test_a_scan_is_reconstructed_while_it_runs(windows: dict[str, str], tmp_path: Path) -> None:
    values = [word for value in SMALL for word in ("--set", value)]
    said = ran(tmp_path, windows, "scan", str(config_folder() / "demo.yaml"), *values)
    (run,) = (tmp_path / "runs").iterdir()
    names = {path.name for path in run.iterdir()}
    assert {"scan.h5", "recon.h5", "report.html"} <= names, said
    assert not [name for name in names if name.endswith((".partial", ".new"))]


def test_a_file_that_a_viewer_holds_open_stays_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Windows answers; the new content is gone, and the old one is whole."""
    path = tmp_path / "volume.h5"
    path.write_text("old", encoding="utf-8")

    def held(*paths: object) -> None:
        raise PermissionError(13, "The process cannot access the file", str(path))

    monkeypatch.setattr(Path, "replace", held)
    with pytest.raises(DataError, match="the existing file was not changed"), atomic_file(path, replace=True) as new:
        new.write_text("new", encoding="utf-8")
    assert [each.name for each in tmp_path.iterdir()] == ["volume.h5"] and path.read_text(encoding="utf-8") == "old"
