"""README's commands for a user who is not root, with a read-only home, LANG=C, and file names in any alphabet."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1200),
    pytest.mark.skipif(sys.platform == "win32", reason="users, HOME and LANG are those of POSIX"),
]

ROOT = Path(__file__).parents[1]
NOBODY = 65534
FILES = (
    "tests/beamline/core/test_files.py", "tests/beamline/core/test_process.py", "tests/beamline/core/test_sinks.py",
    "tests/beamline/storage/volumes/test_files.py", "tests/beamline/cli/test_recon_ended.py",
    "tests/recon/base/test_loaded.py", "tests/recon/base/test_json_values.py",
)  # fmt: skip
"""A few of those of README's second command: files, processes, text, commands with signals, imports."""
_LEFT = {"PATH", "LD_LIBRARY_PATH", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"}


class Elsewhere:
    """A checkout of such a user: of "nobody" where the tests run as root and nobody may run this Python.

    Root writes wherever there is a folder, so that the home of root lies below a file.
    """

    def __init__(self, base: Path) -> None:
        self.checkout, temporary, home = base / "Prüfung µ-試料", base / "tmp of mine", base / "home"
        parts = shutil.ignore_patterns(".*", "__pycache__", "runs", "site", "dist", "build", "shared")
        shutil.copytree(ROOT, self.checkout, ignore=parts)
        temporary.mkdir()
        home.mkdir()
        base.chmod(0o755)
        home.chmod(0o555)
        kept = {name: value for name, value in os.environ.items() if name in _LEFT}
        own = {"HOME": str(home), "TMPDIR": str(temporary), "LANG": "C", "PYTHONPATH": str(self.checkout)}
        self._environment, self.why_root, self._as = kept | own, "", dict[str, Any]()
        if os.getuid() != 0:
            return
        self._as = {"user": NOBODY, "group": NOBODY, "extra_groups": []}
        try:
            self.run("-c", "import numpy, pytest").check_returncode()
        except (OSError, subprocess.CalledProcessError) as error:
            self.why_root, self._as = f"these tests run as root, and nobody cannot run {sys.executable}: {error}", {}
            self._environment["HOME"] = f"{os.devnull}/home"
            return
        for path in (temporary, self.checkout, *self.checkout.rglob("*")):
            os.chown(path, NOBODY, NOBODY)

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """What `python WORDS` prints in the checkout."""
        return subprocess.run(
            [sys.executable, *words], cwd=self.checkout, env=self._environment, capture_output=True, text=True,
            encoding="utf-8", errors="replace", check=False, **self._as,
        )  # fmt: skip


@pytest.fixture(scope="module")
def elsewhere() -> Iterator[Elsewhere]:
    with tempfile.TemporaryDirectory(prefix="splatline user ") as folder:
        yield Elsewhere(Path(folder))


def test_the_user_is_not_root_and_has_a_home_that_is_not_writable(elsewhere: Elsewhere) -> None:
    said = elsewhere.run("-c", "import os; print(os.getuid()); os.mkdir(os.path.expanduser('~/new'))")
    assert said.returncode == 1 and ("PermissionError" in said.stderr or "NotADirectoryError" in said.stderr)
    if elsewhere.why_root:
        pytest.skip(elsewhere.why_root)
    assert said.stdout.strip() != "0"


def test_the_demo_runs(elsewhere: Elsewhere) -> None:
    # a short fit makes the same files; `.ci/wheel` runs README's line as it is
    done = elsewhere.run("-m", "beamline.cli.main", "demo", "--seconds", "1")
    assert done.returncode == 0, done.stderr[-4000:]
    (run,) = (elsewhere.checkout / "runs").iterdir()
    assert {"scan.h5", "recon.h5", "report.html"} <= {path.name for path in run.iterdir()}
    where = elsewhere.run("-c", "import beamline; print(ascii(beamline.__file__))").stdout
    assert ascii(str(elsewhere.checkout))[1:-1] in where


def test_tests_pass(elsewhere: Elsewhere) -> None:
    done = elsewhere.run("-m", "pytest", "-q", "-p", "no:cacheprovider", *FILES)
    assert done.returncode == 0 and " passed" in done.stdout, done.stdout[-4000:] + done.stderr[-2000:]
