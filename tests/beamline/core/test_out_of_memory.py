"""Memory that is not there is no defect: under a limit of address space (ulimit -v), in the words of each library."""

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError, exit_code, is_defect, out_of_memory

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the limit of addresses is Linux's")

LIMITED = """
import ctypes, json, mmap, os, resource, sys, threading
from importlib.util import find_spec
from pathlib import Path
import h5py, numpy as np, psutil
from beamline.core.errors import exit_code, user_message
{imports}

held = threading.Event()

def threads():
    for _ in range(100):
        threading.Thread(target=held.wait, daemon=True).start()

def hdf5():
    with h5py.File(sys.argv[1]) as file:
        file["compressed"][:4]

def library():
    ctypes.CDLL(str(Path(find_spec("llvmlite").origin).with_name("binding") / "libllvmlite.so"))

def maps():
    mmap.mmap(-1, 2**30)

def allocates():
    np.ones(2**28)

{asked}
room = psutil.Process().memory_info().vms + 60_000_000
resource.setrlimit(resource.RLIMIT_AS, (room, room))
said = {{}}
for what in ({names}):
    try:
        what()
    except Exception as error:
        said[what.__name__] = [exit_code(error), user_message(error)]
print(json.dumps(said), flush=True)
os._exit(0)
"""
TORCH = "def torch_allocates():\n    torch.ones(2**30)"


def limited(tmp_path: Path, names: str, imports: str = "", asked: str = "") -> dict[str, tuple[int, str]]:
    with h5py.File(tmp_path / "big.h5", "w") as file:
        file.create_dataset("compressed", data=np.zeros(2**27, np.uint8), chunks=(2**27,), compression="gzip")
    code = LIMITED.format(names=names, imports=imports, asked=asked)
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "big.h5")], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, tuple[int, str]] = json.loads(done.stdout)
    return found


def test_each_library_says_it_in_its_own_words(tmp_path: Path) -> None:
    said = limited(tmp_path, "library, maps, allocates, hdf5, threads")
    assert set(said) == {"library", "maps", "allocates", "hdf5", "threads"}, said
    for name, (code, message) in said.items():
        assert code == DataError.exit_code and "of address space (ulimit -v)" in message, said
        if name != "hdf5":  # its filter says no more than that it failed
            assert message.startswith("Out of memory (") and "what was there is untouched" in message, said


@pytest.mark.slow
def test_torch_too(tmp_path: Path) -> None:
    said = limited(tmp_path, "torch_allocates,", "import torch", TORCH)
    assert said["torch_allocates"][0] == DataError.exit_code, said


def _raised_after(cause: BaseException, error: BaseException) -> BaseException:
    try:
        try:
            raise cause
        except BaseException:
            raise error  # noqa: B904 - as llvmlite does
    except BaseException as seen:
        return seen


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (_raised_after(OSError("x.so: failed to map segment from shared object"), OSError("cannot load it")), True),
        (RuntimeError("[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory: 9 bytes"), True),
        (RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB"), True),
        (RuntimeError("std::bad_alloc"), True),
        (RuntimeError("Resource temporarily unavailable"), True),
        (RuntimeError("no memory of it"), False),
        (ValueError("out of memory"), False),
        (_raised_after(KeyError("a"), RuntimeError("wrong")), False),
        (_raised_after(MemoryError(), DataError("said already")), False),
    ],
)
def test_what_counts_as_memory(error: BaseException, expected: bool) -> None:
    assert out_of_memory(error) == expected
    assert is_defect(error) != (expected or isinstance(error, DataError))
    assert exit_code(error) == (DataError.exit_code if expected or isinstance(error, DataError) else 1)
