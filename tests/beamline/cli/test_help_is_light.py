"""Help and refusals come at once: nothing loads a library that computes, or that only other work needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from beamline.core.process import with_our_path
from tests.beamline.cli.small_scan import SCAN
from tests.beamline.scans import write_exchange

LOADS = """
import contextlib, io, sys
from beamline.cli.commands import commands
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


def test_a_wrong_file_is_refused_before_anything_heavy_is_loaded(tmp_path: Path) -> None:
    (tmp_path / "wrong.h5").write_text("no HDF5", encoding="utf-8")
    (tmp_path / "bad.yaml").write_text("scan: {nonsense: 3}", encoding="utf-8")
    wrong, light = "wrong.h5", ("check home tune scan doctor", "info recover ingest export archive monitor view")
    commands = [f"{name} bad.yaml" for name in light[0].split()]
    commands += [f"{name} {wrong}{' -o out.h5' if name in ('export', 'archive') else ''}" for name in light[1].split()]
    commands[commands.index(f"ingest {wrong}")] += " out.h5"
    kernels = ["recon -m fbp", "recon -m r2", "voxelise -o out.h5", "render -o out.h5", "surface -o out.stl"]
    lines = in_turn(tmp_path, "\n".join(commands + [f"{words} {wrong}" for words in kernels]))
    assert lines[: len(commands)] == [f"{words.split()[0]} refused" for words in commands]
    assert lines[len(commands) :] == [f"{words.split()[0]} refused numba" for words in kernels]


def test_work_loads_what_it_uses(tmp_path: Path) -> None:
    """FBP computes without torch, and without the parts of scipy that take a second to load."""
    write_exchange(tmp_path / "scan.h5", SCAN)
    lines = in_turn(tmp_path, "runs .\nvalidate scan.h5\ninfo scan.h5\nrecon -m fbp scan.h5 -o v.h5 --no-report")
    assert lines == ["runs done", "validate done", "info done", "recon done numba"]
