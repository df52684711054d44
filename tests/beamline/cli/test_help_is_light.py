"""Help comes at once: no command's module loads a library that computes, or that only its work needs."""

from __future__ import annotations

import subprocess
import sys

from beamline.core.process import with_our_path

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
