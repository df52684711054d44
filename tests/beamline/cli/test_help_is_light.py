"""Help and errors come at once: they load no library for computing, and none that only other commands need."""

import subprocess
import sys
from pathlib import Path

import pytest

from beamline.core.process import with_our_path
from tests.beamline.cli.small_scan import SCAN
from tests.beamline.scans import write_exchange

LOADS = """
import contextlib, io, sys
from beamline.cli.main import commands
from beamline.cli.main import main
for name in commands():
    assert main.get_command(None, name) is not None
for words in ["--help"], ["recon", "--help-all"]:
    with contextlib.redirect_stdout(io.StringIO()):
        main(words, standalone_mode=False)
heavy = {"torch", "numba", "scipy", "h5py", "pydantic", "matplotlib", "PIL", "tifffile", "serial", "hdf5plugin"}
print(sorted(heavy & set(sys.modules)))
"""


def test_no_commands_help_loads_what_only_its_work_needs() -> None:
    found = subprocess.run(
        [sys.executable, "-c", LOADS], capture_output=True, text=True, env=with_our_path(), check=True, timeout=120
    )
    assert found.stdout.strip() == "[]"


WORK = """
import contextlib, io, sys
from beamline.cli.main import main

HEAVY = {"torch", "numba", "matplotlib", "xraylib", "jinja2",
         "scipy.stats", "scipy.signal", "scipy.optimize", "scipy.interpolate", "scipy.spatial"}

def loaded(*words):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            ended = "refused" if main(words, standalone_mode=False) else "done"
        except Exception:
            ended = "refused"
    print(words[0], ended, *sorted(HEAVY & set(sys.modules)))

for line in sys.argv[1].splitlines():
    loaded(*line.split())
"""


def in_turn(folder: Path, commands: str) -> list[str]:
    """The commands in one process: each line holds what those up to it have loaded of what takes long to load."""
    words = [sys.executable, "-c", WORK, commands.strip()]
    done = subprocess.run(words, capture_output=True, text=True, env=with_our_path(), cwd=folder, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
def test_work_loads_what_it_uses_and_a_wrong_file_nothing_heavy(tmp_path: Path) -> None:
    """FBP computes without torch, and without the parts of scipy that take a second to load."""
    write_exchange(tmp_path / "scan.h5", SCAN)
    (tmp_path / "wrong.h5").write_text("no HDF5", encoding="utf-8")
    (tmp_path / "bad.yaml").write_text("scan: {nonsense: 3}", encoding="utf-8")
    light = ["runs .", "validate scan.h5", "info scan.h5"]
    wrong = [f"{name} bad.yaml" for name in ("check", "home", "tune", "scan")]
    wrong += [f"{name} wrong.h5" for name in ("info", "recover", "monitor", "view")]
    wrong += ["ingest wrong.h5 out.h5", "export wrong.h5 -o out.h5"]
    kernels = ["recon -m fbp", "recon -m r2", "voxelise -o out.h5", "render -o out.h5", "surface -o out.stl"]
    kernels = [f"{words} wrong.h5" for words in kernels]
    works = "recon -m fbp scan.h5 -o v.h5 --no-report"
    lines = in_turn(tmp_path, "\n".join([*light, *wrong, *kernels, works]))
    names = [[words.split()[0] for words in each] for each in (light, wrong, kernels)]
    assert lines[: len(light)] == [f"{name} done" for name in names[0]]
    assert lines[len(light) : -len(kernels) - 1] == [f"{name} refused" for name in names[1]]
    assert lines[-len(kernels) - 1 :] == [*(f"{name} refused numba" for name in names[2]), "recon done numba"]
