"""What can be tried of Windows and macOS on Linux: consoles with a code page, files that nobody replaces or removes
while they are open, no `fork`, processes by spawn, and folders that ignore the case of names.

A command "as on Windows" runs in a process whose `sitecustomize` takes away what Windows lacks. Paths, locks and
signals stay those of Linux (see `test_platforms`). A folder ignores case because a preloaded library looks names up
like that (Linux; needs `cc`), or because it is a disk of NTFS (needs root and ntfs-3g).
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from beamline.config.load import config_folder
from beamline.core.errors import DataError
from beamline.core.files import atomic_file, same_file

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


RUN = """
import json, sys
from click.testing import CliRunner
from beamline.cli.main import main
done = [CliRunner().invoke(main, words) for words in json.loads(sys.argv[1])]
print(json.dumps([[each.exit_code, each.output] for each in done]))
"""
CASELESS = Path(__file__).with_name("caseless_folder.c")
NTFS = "mkntfs", "lowntfs-3g", "umount"


def _preloaded(tmp_path: Path) -> dict[str, str]:
    made, folder = tmp_path / "caseless.so", tmp_path / "disk"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", made, CASELESS, "-ldl"], check=True, timeout=120)
    return {"LD_PRELOAD": str(made), "CASELESS_FOLDER": str(folder)}


@pytest.fixture(params=["preloaded", "mounted"])
def caseless(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Path, dict[str, str]]]:
    """A folder that ignores the case of names, and the environment of the processes that find it so."""
    folder = tmp_path / "disk"
    folder.mkdir()
    common = {**os.environ, "PYTHONPATH": str(ROOT)}
    if request.param == "preloaded":
        if not sys.platform.startswith("linux") or shutil.which("cc") is None:
            pytest.skip("the library that ignores case needs Linux and a C compiler (cc)")
        yield folder, common | _preloaded(tmp_path)
        return
    if not all(map(shutil.which, NTFS)) or os.geteuid() or not os.access("/dev/fuse", os.R_OK | os.W_OK):
        pytest.skip("a disk of NTFS needs root, ntfs-3g and /dev/fuse")
    image = tmp_path / "disk.img"
    with image.open("wb") as file:
        file.truncate(64 << 20)
    subprocess.run(["mkntfs", "-F", "-f", "-q", image], check=True, capture_output=True, timeout=60)
    subprocess.run(["lowntfs-3g", "-o", "ignore_case", image, folder], check=True, timeout=60)
    yield folder, common
    subprocess.run(["umount", folder], check=True, timeout=60)


def _in(caseless: tuple[Path, dict[str, str]], *commands: str) -> list[tuple[int, str]]:
    """The exit codes and outputs of commands, run one after the other by one process in the folder."""
    words = json.dumps([command.split(" ") for command in commands])
    done = subprocess.run(
        [sys.executable, "-c", RUN, words],
        cwd=caseless[0],
        env=caseless[1],
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.returncode == 0, done.stderr
    return [(code, output) for code, output in json.loads(done.stdout)]


SIMULATE = "simulate plain --frames 24 --set detector.shape=[8,32] --set detector.pixel_size_um=20 -o"


@pytest.mark.slow
def test_a_name_in_other_case_is_the_file_that_exists(caseless: tuple[Path, dict[str, str]]) -> None:
    folder = caseless[0]
    made = _in(caseless, f"{SIMULATE} scan.h5", "recon scan.h5 -m fbp -o volume.h5")
    assert [code for code, _ in made] == [0, 0], made
    before = {path.name: hashlib.sha256(path.read_bytes()).digest() for path in folder.iterdir()}
    exists, same, twice = "exists, and results are never overwritten", "are the same file", "is given for the scan and"
    refused = {
        f"{SIMULATE} SCAN.h5": (5, exists),
        f"{SIMULATE} two.h5 --truth TWO.h5": (2, twice),
        "recon SCAN.h5 -m fbp -o Volume.h5": (5, exists),
        "recon scan.h5 -m fbp -o SCAN.h5": (2, same),
        "recon scan.h5 -m r2 -o new.h5 --checkpoint NEW.h5": (2, same),
        "export volume.h5 -o VOLUME.h5": (2, same),
    }
    for command, (code, output) in zip(refused, _in(caseless, *refused), strict=True):
        expected, text = refused[command]
        assert code == expected and text in " ".join(output.split()), (command, output)
    assert {path.name: hashlib.sha256(path.read_bytes()).digest() for path in folder.iterdir()} == before
    (other,) = _in(caseless, "recon SCAN.h5 -m fbp -o other.h5")
    assert other[0] == 0, other


@pytest.mark.slow
def test_results_whose_names_differ_in_case_get_folders_of_their_own(caseless: tuple[Path, dict[str, str]]) -> None:
    folder = caseless[0]
    assert _in(caseless, f"{SIMULATE} scan.h5")[0][0] == 0
    for name in ("a/scan.h5", "B/SCAN.h5"):
        (folder / name).parent.mkdir()
        shutil.copy(folder / "scan.h5", folder / name)
    (folder / "recipe.yaml").write_text("method: fbp\n", encoding="utf-8")
    (folder / "my.yaml").write_bytes((config_folder() / "simulated.yaml").read_bytes())
    (folder / "queue.csv").write_text("config,sample.name\nmy.yaml,Tooth\nmy.yaml,tooth\n", encoding="utf-8")
    few = (
        "scan.angles.views=12", "scan.period_s=1", "devices.camera.roi=[1140,2032,24,32]",
        "devices.stage.low_deg=-90", "simulation.clock=virtual",
    )  # fmt: skip
    scan = f"scan queue.csv --no-live {' '.join(f'--set {each}' for each in few)}"
    batch = "batch a/scan.h5 B/SCAN.h5 --config recipe.yaml -o"
    made = _in(caseless, scan, f"{batch} day", f"{batch} DAY")
    assert [code for code, _ in made] == [0, 0, 0], made
    assert len({path.name.lower() for path in (folder / "runs").iterdir() if (path / "scan.h5").is_file()}) == 2
    assert len({path.name.lower() for path in (folder / "day").iterdir() if (path / "recon.h5").is_file()}) == 2
    assert len([path for path in folder.iterdir() if path.name.lower() == "day"]) == 1


def test_two_names_are_one_file_where_the_folder_says_so(tmp_path: Path) -> None:
    scan, link = tmp_path / "scan.h5", tmp_path / "link.h5"
    scan.write_text("frames", encoding="utf-8")
    link.symlink_to(scan)
    assert same_file(scan, link) and same_file(tmp_path / "new.h5", tmp_path / "new.h5")
    assert not same_file(scan, tmp_path / "new.h5")
    ignores = (tmp_path / "SCAN.h5").exists()
    assert same_file(scan, tmp_path / "SCAN.h5") is same_file(tmp_path / "new.h5", tmp_path / "NEW.h5") is ignores
    assert not same_file(tmp_path / "missing" / "new.h5", tmp_path / "missing" / "NEW.h5")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.h5", "scan.h5"]
