"""Memory that is not there is no defect: under a limit of address space (ulimit -v), in the words of each library."""

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from beamline.core.errors import DataError, exit_code, is_defect, out_of_memory, user_message

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the limit of addresses is Linux's")


def test_a_limit_below_what_the_libraries_take_is_refused_before_they_are_loaded(tmp_path: Path) -> None:
    """OpenBLAS and LLVM would end the process, or wait for ever."""
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (400_000_000,) * 2); "
        "from beamline.cli.main import run; run()"
    )
    command = [sys.executable, "-c", code, "ingest", "no.h5", str(tmp_path / "out.h5")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == DataError.exit_code and not list(tmp_path.iterdir())
    assert done.stderr.startswith("beamline: Out of memory: this process may use 400 MB of address space (ulimit -v)")


@pytest.mark.parametrize("error", [MemoryError(), OSError(errno.ENOMEM, "Cannot allocate memory")])
def test_memory_that_ran_out_is_no_defect(error: BaseException) -> None:
    assert out_of_memory(error) and not is_defect(error) and exit_code(error) == DataError.exit_code
    assert user_message(error).startswith("Out of memory (")
