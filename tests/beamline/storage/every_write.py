"""A program for test_every_write.py: writes and recovers scans; each time another write fails or kills it.

It is started with the library of tests/faulty_disk.py, forks once for each fault, and prints one JSON object per line.
Many faults leave the same bytes; these are examined with the commands only once. Each state is recovered and read. The
rules take most of the time, so they are applied only to every fourth state.
"""

from __future__ import annotations

import atexit
import ctypes
import errno
import gc
import hashlib
import json
import os
import resource
import shutil
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from beamline.core.errors import DataError
from beamline.features.files.validate import describe, validate
from beamline.monitor.digest import digest
from beamline.storage import hdf5
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.recorded_frames import frames_in
from beamline.storage.recover import recover
from beamline.storage.volumes.images import tiff
from beamline.storage.volumes.zarr import ome_zarr
from beamline.storage.writer_lock import QUIET
from beamline.storage.writers import layout
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.clock import SystemClock
from drivers.base.frame import FrameKind
from tests.beamline.storage.conftest import INFO, scan_frames

LOADED = (ome_zarr, tiff)  # once, before the forks: `info` loads them
LAST, EACH, WHOLE = 100, 40, 4
FRAMES = [
    replace(frame, counts=np.tile(frame.counts, (4, 4))) for frame in scan_frames(np.random.default_rng(5), 2, 3, 15)
]
SHAPE = FRAMES[0].counts.shape
DIGESTS = [digest(frame.counts) for frame in FRAMES]
_DISK = ctypes.CDLL(os.environ["LD_PRELOAD"])
_DISK.faulty_disk_count.restype = ctypes.c_long
_DISK.faulty_disk_arm.argtypes = [ctypes.c_long] * 3 + [ctypes.c_int] * 2

Fault = tuple[int, int, int, int, int]  # kill at, fail from, fail at, errno, torn
NONE: Fault = (0, 0, 0, 0, 0)
# used in turn, because code that writes a scan does not distinguish them
_ERRORS = (errno.ENOSPC, errno.EIO, errno.EFBIG)
FAULTS: dict[str, Callable[[int], Fault]] = {  # by the number of the write
    "kill": lambda n: (n, 0, 0, 0, 0),
    "kill, torn": lambda n: (n, 0, 0, 0, 1),
    "error from": lambda n: (0, n, 0, _ERRORS[n % 3], 0),
    "error at": lambda n: (0, 0, n, _ERRORS[n % 3], 0),
}


class Rig:
    """A folder with the scan, and a child process for each operation on it."""

    def __init__(self, folder: Path) -> None:
        self.scan, self._note, self._said = folder / "w" / "scan.h5", folder / "note", folder / "said"
        self.writer: NXtomoWriter | None = None
        self._children = 0
        self._judged: dict[str, dict[str, Any]] = {}
        self._rules_asked = True

    def fresh(self, kept: Path | None = None) -> None:
        """Reset the folder: it contains only this file as the scan, or nothing."""
        shutil.rmtree(self.scan.parent, ignore_errors=True)
        self.scan.parent.mkdir()
        if kept is not None:
            shutil.copy(kept, self.scan)

    def do(
        self, what: Callable[[], Any], fault: Fault = NONE, limit: int | None = None, fast: bool = False
    ) -> dict[str, Any]:
        """Run something in a child: its result or error, exit code, messages and number of writes."""
        self._note.unlink(missing_ok=True)
        self._children += not fast
        child = os.fork()
        if not child:
            messages = os.open(self._said, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
            os.dup2(messages, 2)
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            _DISK.faulty_disk_arm(*fault)
            try:
                said = {"value": what()}
            except DataError as error:
                said = {"refused": str(error)}
            except BaseException:
                said = {"traceback": traceback.format_exc()}
            said["writes"] = _DISK.faulty_disk_count()
            self._note.write_text(json.dumps(said))
            if fast:
                os._exit(0)
            if self._children % 20 == 0:
                sys.exit()  # end like a program, so that HDF5 closes open files
            atexit._run_exitfuncs()  # the same without Python's shutdown, which takes seconds
            self.writer = None
            gc.collect()
            sys.stderr.flush()
            ctypes.CDLL(None).exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        said = json.loads(self._note.read_text()) if self._note.exists() else {}
        return {"value": None} | said | {"exit": code, "stderr": self._said.read_text()[-2000:]}

    def aged(self) -> None:
        """Make the scan look as if it had not changed for a while."""
        when = self.scan.stat().st_mtime - 2 * QUIET
        os.utime(self.scan, (when, when))

    def judged(self) -> dict[str, Any]:
        """The result of each command on the scan: frames, or its error."""
        content = hashlib.sha256()
        for path in sorted(self.scan.parent.iterdir()):
            content.update(f"{path.name} {path.stat().st_size} ".encode() + path.read_bytes())
        if content.hexdigest() not in self._judged:
            self.aged()
            self._rules_asked = len(self._judged) % WHOLE == 0
            done = self.do(self.commands, fast=True)
            value = done["value"] or {"info": _short(done), "resume": "", "recover": "", "after": "", "again": ""}
            remaining = sorted(path.name for path in self.scan.parent.iterdir())
            self._judged[content.hexdigest()] = value | {"left": remaining}
        return self._judged[content.hexdigest()]

    def commands(self) -> dict[str, Any]:
        """The result of each command, or its error."""
        found: dict[str, Any] = {}
        for name, command in (
            ("info", self.info),
            ("resume", self.resume),
            ("recover", lambda: recover(self.scan).frames),
            ("after", self.after),
            ("again", lambda: recover(self.scan).changed),
        ):
            try:
                found[name] = command()
            except DataError as error:
                found[name] = str(error)
            except Exception:
                found[name] = traceback.format_exc()
        return found

    def info(self) -> int:
        if self._rules_asked:
            return int(describe(SourceOptions(self.scan))["frames"])
        with open_scan(self.scan) as source:
            return len(source.table)

    def resume(self) -> int:
        with hdf5.open_hdf5(self.scan) as file:
            frames_in(file).numbers_taken()
            return int(file[layout.COMMITTED][()])

    def after(self) -> list[int]:
        """The frames of an ordinary file, all as written; the projections in its /exchange view."""
        with h5py.File(self.scan) as file:
            views = len(file["exchange/data"]) if "exchange/data" in file else 0
        with open_scan(self.scan) as source:
            n = len(source.table)
            assert source.finished
            assert all((source.read([i])[0] == FRAMES[i].counts).all() for i in range(n))
            assert views in (0, np.sum(source.table.kinds == FrameKind.PROJECTION))
        rules_hold = views < 2 or not self._rules_asked
        assert rules_hold or not [found for found in validate(self.scan) if found.severity == "error"]
        return [n, views]

    def write(self) -> int:
        """Write a whole scan; returns its remarks."""
        self.writer = NXtomoWriter(self.scan, INFO, SHAPE, clock=SystemClock())
        return self.go_on(self.writer)

    def begin(self) -> Path:
        """Start another scan without the last frames; its writer waits."""
        self.writer = NXtomoWriter(self._note.with_name("begun.h5"), INFO, SHAPE, clock=SystemClock())
        for frame, about in zip(FRAMES[:-2], DIGESTS, strict=False):
            self.writer.append(frame, about)
        return self.writer.path

    def end(self) -> int:
        """Continue the scan that `begin` started, in a copy of its file; returns its remarks."""
        assert self.writer is not None
        copy = os.open(self.scan, os.O_RDWR)
        os.dup2(copy, self.writer._file.file.id.get_vfd_handle())
        os.close(copy)
        self.writer.path = self.scan
        return self.go_on(self.writer)

    def go_on(self, writer: NXtomoWriter) -> int:
        first = writer.rows
        with self._note.with_name("committed").open("w") as note:
            for frame, about in zip(FRAMES[first:], DIGESTS[first:], strict=True):
                try:
                    writer.append(frame, about)
                except DataError:
                    writer.close("failed")
                    raise
                note.write(f"{writer.committed}\n")
                note.flush()
        writer.close()
        return len(writer.remarks)

    def committed(self) -> int:
        """Number of frames that were committed in the last `write`."""
        said = self._note.with_name("committed").read_text().split()
        return int(said[-1]) if said else 0

    def died(self) -> Path:
        """A scan whose writer was killed with uncommitted rows, as a starting point."""
        self.fresh()

        def write() -> None:
            writer = NXtomoWriter(self.scan, INFO, SHAPE, clock=SystemClock(), flush_every=10)
            for frame, about in zip(FRAMES, DIGESTS, strict=True):
                writer.append(frame, about)
            os.kill(os.getpid(), signal.SIGKILL)

        self.do(write)
        kept = self._note.with_name("scan.h5")
        shutil.copy(self.scan, kept)
        return kept


def _short(said: dict[str, Any]) -> Any:
    """The value, or the error on one line."""
    if said["exit"]:
        return f"exit {said['exit']}"
    return said.get("refused") or said.get("traceback") or said["value"]


def close(rig: Rig) -> None:
    begun = rig.begin()
    rig.fresh(begun)
    total = rig.do(rig.end)["writes"]
    last = range(total - LAST + 1, total + 1)
    kills = [n for n in last if n > total - EACH or n % 3 == 0]
    for fault, numbers in (("kill", kills), ("error from", last[::4])):  # 4 and the number of errors share no divisor
        for n in numbers:
            rig.fresh(begun)
            done = rig.do(rig.end, FAULTS[fault](n))
            committed = max(rig.committed(), len(FRAMES) - 2)
            said(fault, n, done, rig.judged() | {"committed": committed})
    sys.stdout.flush()
    os._exit(0)  # without closing the writer


def recovering(rig: Rig) -> None:
    kept = rig.died()
    rig.aged()
    total = rig.do(lambda: recover(rig.scan).frames)["writes"]
    for fault in FAULTS:
        for n in sorted(
            {*range(1, total, max(1, total // 8)), *range(total - 5, total + 1)}
        ):  # the last put it in place
            rig.fresh(kept)
            rig.aged()
            done = rig.do(lambda: recover(rig.scan).frames, FAULTS[fault](n))
            said(fault, n, done, rig.judged() | {"committed": 10 * (len(FRAMES) // 10)})


def cut(rig: Rig) -> None:
    """The file system limits the length of files; `recover` runs with the same limit, and for every fourth without
    it."""
    rig.fresh()
    rig.do(rig.write)
    size = rig.scan.stat().st_size
    pixels = sum(frame.counts.nbytes for frame in FRAMES)
    for n, limit in enumerate(range(size - pixels - 20_000, size, (pixels + 20_000) // 16)):
        bounds = [limit] if n % 4 else [limit, None]  # the second takes long
        for bound in bounds:
            rig.fresh()
            done = rig.do(rig.write, limit=limit)
            rig.aged()
            again = rig.do(lambda: recover(rig.scan).frames, limit=bound)
            said("limit", limit, done, rig.judged() | {"under": _short(again), "committed": rig.committed()})


def said(fault: str, n: int, done: dict[str, Any], found: dict[str, Any]) -> None:
    print(json.dumps({"fault": fault, "n": n, "done": _short(done), "stderr": done["stderr"]} | found), flush=True)


if __name__ == "__main__":
    gc.freeze()
    {"close": close, "recover": recovering, "cut": cut}[sys.argv[2]](Rig(Path(sys.argv[1])))
