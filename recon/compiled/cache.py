"""numba's cache of compiled kernels, such that nothing depends on it.

A kernel is read from the archive that comes with the package, where it lies, else from what numba wrote earlier; else
it is compiled. A file that is damaged counts as absent and is written anew. Where no folder can be written, or a disk
is full, kernels are compiled in memory, with one warning.

A process that is forked after parallel kernels have run computes the same by them, on the thread that calls.

numba imports this module when it makes its first cache, as LOCATORS names it; nothing else need be imported for it.
"""

from __future__ import annotations

import io
import os
import pickle
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import llvmlite.binding as llvm
from numba.core import caching, config
from numba.core.compiler_lock import global_compiler_lock
from numba.np.ufunc import parallel

from recon.compiled.archive import carried, sealed, unsealed


class UnwritableFolder(caching.InTreeCacheLocator):
    """The `__pycache__` beside a kernel where no folder can be written: what lies there may be read."""

    def ensure_cache_path(self) -> None:
        """Nothing is written."""


class KernelCacheFile(caching.IndexDataCacheFile):
    """The index of a kernel and its object code, each with a digest; a file without one is taken as numba takes it."""

    def load(self, key: Any) -> Any:
        files = carried(self._source_stamp)
        with suppress(Exception):  # a pickle of damaged bytes can raise anything, and there may be none
            index = next(name for name in files if _without_python(name) == _without_python(self._index_name))
            overloads = self._overloads(files[index])
            return pickle.loads(files[next(overloads[known] for known in overloads if _same(known, key))])  # noqa: S301
        with suppress(Exception):
            return super().load(key)
        return None

    def _load_index(self) -> dict[Any, str]:
        try:
            return self._overloads(unsealed(Path(self._index_path).read_bytes()))
        except Exception:
            return {}

    def _overloads(self, content: bytes) -> dict[Any, str]:
        """Names of files of object code, by what they were compiled for."""
        file = io.BytesIO(content)
        if pickle.load(file) != self._version:  # noqa: S301 - numba's, as trustworthy as the modules beside it
            return {}
        stamp, overloads = pickle.load(file)  # noqa: S301
        return dict(overloads) if stamp == self._source_stamp else {}

    def _load_data(self, name: str) -> Any:
        return pickle.loads(unsealed(Path(self._data_path(name)).read_bytes()))  # noqa: S301

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[IO[bytes]]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(sealed(content.getvalue()))


def _without_python(name: str) -> str:
    """A name of numba's cache without the version of Python: scaled.scaled-5.py311.nbi."""
    return re.sub(r"\.py\d+\.", ".", name)


def _same(known: Any, key: Any) -> bool:
    """Keys of the same types, processor and closure. The source is the same; its bytecode is Python's affair."""
    return bool(known[:2] == key[:2] and known[2][1] == key[2][1])


@contextmanager
def _in_memory_where_refused(cache: caching.Cache) -> Iterator[None]:
    """Kernels that the disk refuses stay in memory; the first one causes a warning."""
    try:
        yield
    except OSError as error:
        if not _told:
            _told.append(cache.cache_path)
            warnings.warn(
                f"compiled kernels cannot be kept ({cache.cache_path}: {error.strerror or error}): they are compiled "
                "in memory, each time. Set NUMBA_CACHE_DIR to a folder that can be written.",
                stacklevel=2,
            )


_told = list[str]()
os.environ.pop("NUMBA_CACHE_LOCATOR_CLASSES", None)  # programs begun from here may know numba, and not this module
caching.IndexDataCacheFile = KernelCacheFile
caching.Cache._guard_against_spurious_io_errors = _in_memory_where_refused

_LOOP = """
declare i32 @getpid()
define void @run(ptr %work, ptr %args, ptr %n, ptr %steps, ptr %data, i64 %inner, i64 %arrays, i32 %threads) {{
  %process = call i32 @getpid()
  %is_here = icmp eq i32 %process, {process}
  br i1 %is_here, label %here, label %forked
here:
  call void inttoptr (i64 {threaded} to ptr)(ptr %work, ptr %args, ptr %n, ptr %steps, ptr %data, i64 %inner,
                                             i64 %arrays, i32 %threads)
  ret void
forked:
  call void %work(ptr %args, ptr %n, ptr %steps, ptr %data)
  ret void
}}
"""
"""numba's parallel loop, as its `omppool.cpp` declares it, where this is not {process}: one `work` does all `n`.

A fork copies one thread. GNU OpenMP, by which numba runs the parts of a kernel, would wait for the others, so numba
ends such a process.
"""
_IMPORTED_IN = os.getpid()
_loops = list[Any]()  # whose machine code lives as long


_launched_by_numba = parallel._launch_threads


def _launch() -> None:
    """As numba; where the layer that NUMBA_THREADING_LAYER states cannot be had, with another one."""
    try:
        _launched_by_numba()
    except ValueError as error:
        stated, config.THREADING_LAYER = config.THREADING_LAYER, "default"
        _launched_by_numba()
        warnings.warn(
            f"NUMBA_THREADING_LAYER={stated} in the environment is not used. Another layer is. Unset it "
            f"({str(error).splitlines()[0]}).",
            stacklevel=2,
        )


def _launch_threads() -> None:
    """As above, with the loop above before that of the threads."""
    if _loops:
        return
    process = _IMPORTED_IN if parallel._is_initialized else os.getpid()  # others may have launched them
    _launch()
    loop = llvm.parse_assembly(_LOOP.format(process=process, threaded=llvm.address_of_symbol("numba_parallel_for")))
    _loops.append(llvm.create_mcjit_compiler(loop, llvm.Target.from_default_triple().create_target_machine()))
    llvm.add_symbol("numba_parallel_for", _loops[0].get_function_address("run"))
    if sys.platform != "win32":  # which has no forks
        # A kernel that another thread compiles is finished before the fork: its lock would stay locked in the child.
        lock = global_compiler_lock
        os.register_at_fork(before=lock.acquire, after_in_parent=lock.release, after_in_child=_forked)


def _forked() -> None:
    global_compiler_lock.release()
    torch: Any = sys.modules.get("torch")
    if hasattr(torch, "set_num_threads"):
        torch.set_num_threads(1)  # its OpenMP would wait, too


parallel._launch_threads = _launch_threads if hasattr(os, "register_at_fork") else _launch  # Windows has no forks
