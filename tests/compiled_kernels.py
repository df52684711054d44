"""python -m tests.compiled_kernels [CHECKOUT ...]: compiles the kernels for every level, and packs them.

The list of kernels and types comes from the archive, and from what numba has compiled in this checkout and in others
that are named. After the tests have run, this is everything that they call. An edited or new kernel is compiled here
for all levels; all others keep their bytes. No kernel is run, so the machine need not support the instructions of a
level.
"""

from __future__ import annotations

import ast
import gc
import hashlib
import importlib
import io
import json
import lzma
import os
import pickle
import subprocess
import sys
import tarfile
import time
import zipfile
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from recon.compiled import LEVELS, ROOT
from recon.compiled.archive import (
    ARCHIVE,
    PYTHONS,
    SOURCES,
    digest,
    fresh_members,
    member,
    read_sources,
    source_path,
    unsealed,
)

PACKAGES = ("beamline", "recon", "simulators")
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the same files make the same archive
Index = dict[Any, str]
"""Names of files with object code by what they were compiled for: (types, processor, code)."""


def main() -> int:
    """Compile for each level in a separate process, then pack."""
    if sys.version_info[:2] != PYTHONS[0]:
        sys.stdout.write("Make the archive by Python {}.{}: others read what it writes.\n".format(*PYTHONS[0]))
        return 2
    for level in LEVELS:
        begin = time.perf_counter()
        # import numba before recon, so that this level is used although the processor may have another one
        run = "import numba, sys; from tests.compiled_kernels import compile_for; compile_for(sys.argv[1:])"
        words = [sys.executable, "-c", run, *(str(Path(checkout).resolve()) for checkout in sys.argv[1:])]
        done = subprocess.run(words, cwd=ROOT, env=os.environ | level.environment, check=False)
        sys.stdout.write(f"{level.name}: {time.perf_counter() - begin:.0f} s\n")
        if done.returncode:
            return done.returncode
    carried = {} if not ARCHIVE.is_file() else {name: member(ARCHIVE, name) for name in fresh_members(ARCHIVE, ROOT)}
    known = sorted({*carried, *_modules(ROOT)})
    members = {module: files for module in known if (files := _packed(module, carried.get(module, {})))}
    write_archive(ARCHIVE, members, ROOT)
    sys.stdout.write(f"{ARCHIVE}: {len(members)} modules, {ARCHIVE.stat().st_size / 1e6:.2f} MB\n")
    return 0


def compile_for(checkouts: Sequence[str]) -> None:
    """Compile every kernel for its known types; types with which it no longer compiles are left out."""
    import numba
    from numba.core.dispatcher import Dispatcher

    compiled = 0
    signatures = _signatures([ROOT, *map(Path, checkouts)])
    for module in sorted({module for module, _ in signatures}):
        loaded = importlib.import_module(module)
        for value in list(vars(loaded).values()):
            getattr(value, "_dispatcher", None)  # `recon.base.jit` makes it when it is first asked for
        kernels = [d for d in gc.get_objects() if issubclass(type(d), Dispatcher) and d.py_func.__module__ == module]
        for kernel in kernels:
            for types in signatures.get((module, kernel.py_func.__qualname__), ()):
                try:
                    kernel.compile(types)
                    compiled += 1
                except (numba.core.errors.NumbaError, TypeError) as error:  # TypeError: other numbers of arguments
                    sys.stdout.write(f"{module}.{kernel.py_func.__qualname__}{types}: {type(error).__name__}\n")
    sys.stdout.write(f"{compiled} signatures\n")


def _modules(root: Path) -> list[str]:
    """Modules for which numba has stored compiled code next to the source."""
    modules = set()
    for package in PACKAGES:
        for index in (root / package).rglob("__pycache__/*.nbi"):
            source = index.parents[1] / f"{index.name.split('.')[0]}.py"
            if source.is_file():
                modules.add(".".join(source.relative_to(root).with_suffix("").parts))
    return sorted(modules)


def _compiled_here(module: str, root: Path) -> dict[str, bytes]:
    """The files, by name, that numba has stored next to a module for its kernels."""
    source = root.joinpath(*module.split("."))
    found = {}
    for path in (source.parent / "__pycache__").glob(f"{source.name}.*.{_tag()}.*nb[ic]"):
        with suppress(OSError, ValueError):  # damaged
            found[path.name] = unsealed(path.read_bytes())
    return found


def _tag() -> str:
    return "py{}{}".format(*sys.version_info[:2])


def _signatures(roots: Sequence[Path]) -> dict[tuple[str, str], set[Any]]:
    """The types for which kernels were compiled, by module and name."""
    signatures = defaultdict[tuple[str, str], set[Any]](set)
    members = [(name, member(ARCHIVE, name)) for name in (read_sources(ARCHIVE) if ARCHIVE.is_file() else ())]
    members += [(name, _compiled_here(name, root)) for root in roots for name in _modules(root)]
    packed = [(module, *each) for module, files in members for each in files.items() if each[0].endswith(".nbi")]
    for module, name, content in packed:
        try:
            importlib.import_module(module)  # unpickling the types needs the module
            _, index = _read(content)
        except (ImportError, AttributeError):  # a module or a type has another name now
            continue
        # tv._dual_step-94.py311.nbi, voxelize._filler.locals.kernel-155.py311.nbi
        kernel = name.partition(".")[2].rsplit("-", 1)[0].replace(".locals.", ".<locals>.")
        signatures[module, kernel].update(key[0] for key in index)
    return signatures


def _read(content: bytes) -> tuple[Any, Index]:
    """The source's digest and the overloads of numba's index."""
    version = pickle.loads(content)  # noqa: S301 - written by numba beside our own modules
    import numba

    if version != numba.__version__:
        return None, {}
    stamp, index = pickle.loads(content[len(pickle.dumps(version, -1)) :])  # noqa: S301
    return stamp, index


def _packed(module: str, carried: Mapping[str, bytes]) -> dict[str, bytes]:
    """The cache files for the kernels of a module that were compiled for a level from the present source.

    Args:
        carried: files in the archive that are still valid; they stay unchanged if nothing was added.
    """
    from numba import __version__
    from numba.core.serialize import dumps

    importlib.import_module(module)
    source, files = str(digest(ROOT.joinpath(*module.split(".")).with_suffix(".py"))), dict(carried)
    processors = {(level.name, level.features) for level in LEVELS}
    here = _compiled_here(module, ROOT)
    for name, content in here.items():
        stamp, index = _read(content) if name.endswith(".nbi") else (None, {})
        if stamp is None or stamp.hex() != source:
            continue
        known = _read(carried[name])[1] if name in carried else {}
        renamed = dict(known)
        for key, code in index.items():
            if key not in known and tuple(key[1][1:]) in processors and code in here:
                renamed[key] = f"{name[:-4]}.{hashlib.sha256(here[code]).hexdigest()[:16]}.nbc"
                files[renamed[key]] = here[code]
        if renamed != known:
            ordered = dict(sorted(renamed.items(), key=lambda item: item[1]))
            files[name] = pickle.dumps(__version__, -1) + dumps((stamp, ordered))
    return files


def write_archive(archive: Path, members: Mapping[str, Mapping[str, bytes]], root: Path) -> None:
    """Writes the archive from the files of each module; the same files make the same bytes."""
    sources = {}
    with zipfile.ZipFile(archive, "w") as packed:
        for module, files in sorted(members.items()):
            sources[module] = {path: str(digest(root / path)) for path in source_files(module, root)}
            packed.writestr(zipfile.ZipInfo(module, _EPOCH), lzma.compress(_tar(files)))
        packed.writestr(
            zipfile.ZipInfo(SOURCES, _EPOCH), json.dumps(sources, indent=0, allow_nan=False), zipfile.ZIP_DEFLATED
        )


def _tar(files: Mapping[str, bytes]) -> bytes:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as tar:
        for name, data in sorted(files.items()):
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            tar.addfile(entry, io.BytesIO(data))
    return content.getvalue()


def source_files(module: str, root: Path) -> list[str]:
    """A module and all modules of this project that it imports when it is loaded, by path under the root."""
    paths, waiting = set[str](), [_file(module, root)]
    while waiting:
        path = waiting.pop()
        if path is not None and path not in paths:
            paths.add(path)
            waiting += (_file(name, root) for name in _imported(root / path))
    return sorted(paths)


def _file(module: str, root: Path) -> str | None:
    path = source_path(module)
    return path if (root / path).is_file() else None


def _imported(path: Path) -> Iterable[str]:
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.Import):
            yield from (name.name for name in statement.names)
        elif isinstance(statement, ast.ImportFrom) and statement.module is not None:
            yield statement.module
            yield from (f"{statement.module}.{name.name}" for name in statement.names)


if __name__ == "__main__":
    sys.exit(main())
