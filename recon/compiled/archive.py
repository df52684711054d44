"""The archive of compiled kernels: a zip with one member for each module, which is read without unpacking it to disk.

A member contains the files of numba's cache for the kernels of a module (indices, `.nbi`, and object code, `.nbc`), as
a tar compressed by xz. `sources.json` lists the source files from which the kernels were compiled: the module and
everything of this project that it imports. This is necessary because numba copies functions and constants of other
modules into a kernel, and does not notice when they change. A member whose sources differ is not used, and its kernels
are compiled again.

numba's files are pickles, which can run any code when they are loaded. The archive is part of the package and as
trustworthy as its modules. Checksums of zip and xz reveal damage.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import lzma
import struct
import sys
import tarfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
"""The folder that contains the packages `beamline`, `recon` and `simulators`."""
ARCHIVE = Path(__file__).with_name("kernels.zip")
PYTHONS = ((3, 11), (3, 12), (3, 13))
"""Python versions with which the archive was tested; the first one made it.

Its files do not depend on the Python version.
"""
SOURCES = "sources.json"
_DAMAGE = (
    *(OSError, ValueError, KeyError, EOFError, RuntimeError, OverflowError, struct.error),
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, tarfile.TarError),
)
_MARK = b"sha256:"  # marks the digest at the end of a file; pickle does not read that far
_SEAL = len(_MARK) + hashlib.sha256().digest_size


@lru_cache(maxsize=8)
def carried(source: bytes) -> Mapping[str, bytes]:
    """The files of numba's cache for the module whose source has this digest; empty if there are no undamaged ones."""
    with contextlib.suppress(*_DAMAGE):
        module = _carried_modules(ARCHIVE).get(source.hex()) if sys.version_info[:2] in PYTHONS else None
        return {} if module is None else member(ARCHIVE, module)
    return {}


@lru_cache
def _carried_modules(archive: Path) -> dict[str, str]:
    """The modules whose kernels can be used, by the digest of their source."""
    sources = read_sources(archive)
    return {sources[module][source_path(module)]: module for module in fresh_members(archive, ROOT)}


def fresh_members(archive: Path, root: Path) -> Iterator[str]:
    """The modules whose kernels were compiled from the present sources under `root`."""
    digests: dict[str, str | None] = {}
    for module, sources in read_sources(archive).items():
        for path in sources:
            if path not in digests:
                digests[path] = digest(root / path)
        if all(digests[path] == expected for path, expected in sources.items()):
            yield module


def read_sources(archive: Path) -> dict[str, dict[str, str]]:
    """Digests of the source files, by path under the root, of each member."""
    with zipfile.ZipFile(archive) as packed:
        sources: dict[str, dict[str, str]] = json.loads(packed.read(SOURCES))
    return sources


def member(archive: Path, module: str) -> dict[str, bytes]:
    """The files of numba's cache for a module, by name."""
    with zipfile.ZipFile(archive) as packed:
        content = lzma.decompress(packed.read(module))
    files = {}
    with tarfile.open(fileobj=io.BytesIO(content)) as tar:
        for entry in tar:
            if (file := tar.extractfile(entry)) is not None and entry.name == Path(entry.name).name:
                files[entry.name] = file.read()
    return files


def digest(path: Path) -> str | None:
    """A digest of a file's content; None if the file cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None


def source_path(module: str) -> str:
    """The source file of a module, by path under the root."""
    return "/".join(module.split(".")) + ".py"


def sealed(content: bytes) -> bytes:
    """The content of a file with its digest at the end."""
    return content + _MARK + hashlib.sha256(content).digest()


def unsealed(content: bytes) -> bytes:
    """The content of a file without its digest, if it has one. ValueError if the digest does not match."""
    if not content[-_SEAL:].startswith(_MARK):
        return content
    if sealed(content[:-_SEAL]) != content:
        raise ValueError("the content does not match its digest")
    return content[:-_SEAL]
