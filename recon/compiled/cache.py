"""numba's cache of compiled kernels, changed so that a missing or damaged cache never causes an error.

A kernel is read from the archive in the package, otherwise from files that numba wrote earlier; otherwise it is
compiled. A damaged file counts as missing and is written again. If no folder is writable, or the disk is full, kernels
are compiled in memory, with one warning.

A process that is forked after parallel kernels have run computes the same with them, on the calling thread.

numba imports this module when it makes its first cache, because LOCATORS names it. No other import is needed.
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
    """The `__pycache__` next to a kernel if no folder is writable; existing files in it can still be read."""

    def ensure_cache_path(self) -> None:
        """Does nothing, because nothing is written."""


class KernelCacheFile(caching.IndexDataCacheFile):
    """The index of a kernel and its object code, each with a digest.

    A file without a digest is read as numba reads it.
    """

    def load(self, key: Any) -> Any:
        files = carried(self._source_stamp)
        with suppress(Exception):  # a damaged pickle can raise any exception, and the file may be missing
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
        """Names of the files of object code, by the key for which they were compiled."""
        file = io.BytesIO(content)
        if pickle.load(file) != self._version:  # noqa: S301 - numba's file, as trustworthy as the modules next to it
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
    """Whether two keys have the same types, processor and closure.

    The source is the same; bytecode differs with Python.
    """
    return bool(known[:2] == key[:2] and known[2][1] == key[2][1])


@contextmanager
def _in_memory_where_refused(cache: caching.Cache) -> Iterator[None]:
    """Keeps kernels in memory if they cannot be written to disk; the first one causes a warning."""
    try:
        yield
    except OSError as error:
        if not _reported:
            _reported.append(cache.cache_path)
            warnings.warn(
                f"set NUMBA_CACHE_DIR to a writable folder: compiled kernels cannot be stored ({cache.cache_path}: "
                f"{error.strerror or error}), so they are compiled again in each process",
                stacklevel=2,
            )


_reported = list[str]()
os.environ.pop("NUMBA_CACHE_LOCATOR_CLASSES", None)  # programs started from here may import numba without this module
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
"""numba's parallel loop (declared in its `omppool.cpp`), replaced in a process other than {process}: one `work` does
all `n`.

A fork copies only one thread. GNU OpenMP, with which numba runs the parts of a kernel, would wait for the other
threads. Therefore numba normally ends such a process.
"""
_IMPORTED_IN = os.getpid()
_loops = list[Any]()  # kept, because its machine code must live as long


_launched_by_numba = parallel._launch_threads


def _launch() -> None:
    """As in numba; if the layer in NUMBA_THREADING_LAYER is not available, with another layer."""
    try:
        _launched_by_numba()
    except ValueError as error:
        stated, config.THREADING_LAYER = config.THREADING_LAYER, "default"
        _launched_by_numba()
        warnings.warn(
            f"Unset NUMBA_THREADING_LAYER: the layer {stated} is not available ({str(error).splitlines()[0]}), so "
            "another layer is used.",
            stacklevel=2,
        )


def _launch_threads() -> None:
    """As above; it also puts the loop above in front of the loop of the threads."""
    if _loops:
        return
    process = _IMPORTED_IN if parallel._is_initialized else os.getpid()  # another module may have launched the threads
    _launch()
    loop = llvm.parse_assembly(_LOOP.format(process=process, threaded=llvm.address_of_symbol("numba_parallel_for")))
    _loops.append(llvm.create_mcjit_compiler(loop, llvm.Target.from_default_triple().create_target_machine()))
    llvm.add_symbol("numba_parallel_for", _loops[0].get_function_address("run"))
    if sys.platform != "win32":  # Windows has no fork
        # Wait for kernels that another thread compiles, because its lock would stay locked in the child process.
        lock = global_compiler_lock
        os.register_at_fork(before=lock.acquire, after_in_parent=lock.release, after_in_child=_forked)


def _forked() -> None:
    global_compiler_lock.release()
    torch: Any = sys.modules.get("torch")
    if hasattr(torch, "set_num_threads"):
        torch.set_num_threads(1)  # its OpenMP would also wait for threads


parallel._launch_threads = _launch_threads if hasattr(os, "register_at_fork") else _launch  # Windows has no fork
