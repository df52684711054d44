"""The same tests with a fake compiled with address and undefined-behaviour sanitisers: the ABI is used correctly."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.drivers.dcam.fake import READY_MADE, build, compiler

FLAGS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")
HERE = Path(__file__).parent
ROOT = HERE.parents[2]
SUITE = ("test_abi.py", "test_camera.py", "test_options.py", "test_faults.py", "test_ring_law.py")
OVERFLOW = """
import sys
from pathlib import Path
from tests.drivers.dcam.fake import World
world = World(Path(sys.argv[1]))
world.fault("short_ring")  # the library's buffers end a byte early
world.connect()
"""


def _preloaded() -> Path:
    found = subprocess.run([compiler(), "-print-file-name=libasan.so"], capture_output=True, text=True, check=True)
    runtime = Path(found.stdout.strip())
    if not runtime.is_absolute() or not runtime.exists():
        pytest.skip("gcc has no address sanitiser here")
    return runtime.resolve()


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Of a process that loads the sanitised library."""
    if READY_MADE in os.environ:
        pytest.skip("this is the sanitised run")
    runtime = _preloaded()
    try:
        library = build(tmp_path_factory.mktemp("sanitised"), *FLAGS)
    except subprocess.CalledProcessError as error:
        pytest.skip(f"gcc cannot sanitise here: {error.stderr.decode()[-300:]}")
    # Leaks are counted by the fake itself: Python's own would drown them.
    options = {"ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0", "LD_PRELOAD": str(runtime)}
    return {**os.environ, **options, READY_MADE: str(library), "PYTHONPATH": str(ROOT)}


def _run(environment: dict[str, str], *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=200)


@pytest.mark.slow
@pytest.mark.long
def test_the_suite_passes_under_sanitisers(environment: dict[str, str]) -> None:
    ran = _run(environment, "-m", "pytest", "-q", "-p", "no:cacheprovider", *(str(HERE / name) for name in SUITE))
    assert ran.returncode == 0, (ran.stdout + ran.stderr)[-4000:]
    assert "ERROR: AddressSanitizer" not in ran.stderr
    passed = re.search(r"(\d+) passed", ran.stdout)
    assert passed is not None and int(passed[1]) > 120


def test_the_sanitiser_reports_an_overflow(environment: dict[str, str]) -> None:
    """That the suite passes means something only if an overflow does not."""
    ran = _run(environment, "-c", OVERFLOW, environment[READY_MADE])
    assert ran.returncode != 0
    assert "heap-buffer-overflow" in ran.stderr
