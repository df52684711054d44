"""Help and refusals come at once: nothing loads a library that computes, or that only other work needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from beamline.core.process import with_our_path
from tests.beamline.cli.small_scan import SCAN
from tests.beamline.scans import write_exchange

LOADS = """
import sys
from importlib import import_module
from beamline.cli.main import _COMMANDS, main
for name, entry in _COMMANDS.items():
    assert main.get_command(None, name) is not None
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

def loaded(*words):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(Exception):
        main(words, standalone_mode=False)
    print(words[0], *sorted({"torch", "numba", "scipy.stats", "matplotlib", "xraylib", "jinja2"} & set(sys.modules)))

loaded("runs", ".")
loaded("recon", "nowhere.h5", "-m", "fbp")
loaded("validate", "scan.h5")
loaded("info", "scan.h5")
"""


def test_work_loads_what_it_uses(tmp_path: Path) -> None:
    """In turn in one process: each line holds what the commands up to it have loaded."""
    write_exchange(tmp_path / "scan.h5", SCAN)
    found = subprocess.run(
        [sys.executable, "-c", WORK], capture_output=True, text=True, env=with_our_path(), cwd=tmp_path, timeout=120
    )
    assert found.stdout.splitlines() == ["runs", "recon", "validate", "info"], found.stderr
