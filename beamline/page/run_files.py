"""The folder of the run, or the scan file, that the page shows: its events, and one thread that reads HDF5."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from beamline.core.errors import DataError
from beamline.core.event_lines import LARGEST_LOG, event_in
from beamline.core.files import EVENTS, JOINED, RECON, SCAN, is_below, open_below, parts_of, run_of
from beamline.page.recording import Recording
from beamline.page.volume import ShownVolume, VolumeFile, newest
from beamline.storage.hdf5 import NotReadyError
from beamline.storage.interrupted import next_step
from beamline.storage.parts import joined_file_of
from beamline.storage.run_record import DIED, read_record
from beamline.storage.writer_lock import abandoned

_ADVISED_FOR = 10.0  # s for which the next step is valid, because finding it opens files
_AT_ONCE = 2**24  # largest number of bytes of a log that are read in one call
SNAPSHOT, PICTURE = "recon.snapshot.h5", "recon.live.png"
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Watched:
    """Paths of a run that the page shows."""

    scan: Path  # the scan file
    folder: Path | None  # log of the run (of its newest part); None: there is only a scan file

    @property
    def name(self) -> str:
        return self.scan.name if self.folder is None else self.folder.resolve().name

    @property
    def run(self) -> Path | None:
        """The folder of the run, which contains the volume of all parts; None for a single scan file."""
        return None if self.folder is None else run_of(self.folder.resolve())

    @property
    def volumes(self) -> tuple[Path, ...]:
        """Paths of the existing volumes of the run."""
        return tuple(self.run / name for name in (RECON, SNAPSHOT) if is_below(self.run, name)) if self.run else ()


def watched(path: Path) -> Watched:
    """The paths for the folder of a run, or for a scan file. If the parts of a run are joined, the scan file is the
    joined file. Raises DataError if there is neither."""
    if path.is_dir():
        folder = parts_of(path)[-1]
        if not is_below(folder, EVENTS):
            raise DataError(
                f"{path} is not the folder of a run: it has no {EVENTS}. Name a run, or a scan file; "
                f"`beamline view {path}` shows images."
            )
        return Watched(_joined(folder), folder)
    if not path.is_file():
        raise DataError(f"{path} does not exist.")
    of_run = path.name == SCAN and is_below(path.parent, SCAN) and is_below(path.parent, EVENTS)
    return Watched(_joined(path.parent), path.parent) if of_run else Watched(path, None)


def _joined(part: Path) -> Path:
    """The file with all parts of the run to which a file belongs, if there is one; otherwise the file itself."""
    joined = joined_file_of(part / SCAN) if is_below(run_of(part), JOINED) else None
    return part / SCAN if joined is None else joined[0]


class EventLog:
    """The events of a run as lines of JSON, numbered from 0 in the order of the file. An incomplete line is returned by
    the next call; a line that is not an event is skipped and counted.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder, self._at, self._within = folder, 0, False
        self.lines: list[str] = []
        self.skipped = 0

    def refresh(self) -> None:
        """Read new lines, up to a limit of bytes."""
        if self._folder is None or self._at > LARGEST_LOG:
            return
        with suppress(OSError), open_below(self._folder, EVENTS) as file:
            file.seek(self._at)
            added = file.read(_AT_ONCE)
            *complete_lines, incomplete_line = added.split(b"\n")
            if not complete_lines and len(added) == _AT_ONCE:  # a line without end
                self._at, self._within = self._at + len(added), True
                return
            self._at += len(added) - len(incomplete_line)
            for line in complete_lines:
                self._add(b"" if self._within else line)
                self._within = False

    def _add(self, line: bytes) -> None:
        # a carriage return would end a line of server-sent events
        if b"\r" not in (line := line.strip()) and event_in(line) is not None:
            self.lines.append(line.decode())
        else:
            self.skipped += 1


class Reader:
    """Opens scan and volume as soon as they exist, and reads HDF5 only in one thread."""

    def __init__(self, what: Watched) -> None:
        self.what, self.events = what, EventLog(what.folder)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="reader")
        self._recording: Recording | None = None
        self._volume: ShownVolume | None = None
        self._volume_file: VolumeFile | None = None
        self._seen = 0, time.time()
        # the time at which the next step was determined, and the next step
        self._advice: tuple[tuple[bool, float], str] = (False, 0.0), ""
        self._lock = threading.Lock()

    def close(self) -> None:
        def close_files() -> None:
            for file in (self._recording, self._volume):
                if file is not None:
                    file.close()

        self._thread.submit(close_files)
        self._thread.shutdown()

    def do(self, read: Callable[[Recording], _Result]) -> _Result:
        """Call `read` in the reading thread, and return its result. Raises NotReadyError or DataError if the file
        cannot be read.
        """
        return self._thread.submit(lambda: read(self._open())).result()

    def on_volumes(self, read: Callable[[Sequence[ShownVolume]], _Result]) -> _Result:
        """The same for the newest volume. Raises DataError if there is no volume."""
        return self._thread.submit(lambda: read([self._newest_volume()])).result()

    def state(self) -> dict[str, Any]:
        """The state of the run: number of frames in the file; status of the file, or of the run if its process has
        ended (`over`), and in this case what can be done next; seconds since the last frame; time of the newest frame;
        free bytes; name of the newest volume."""
        self.events.refresh()
        try:
            progress = self.do(Recording.progress)
            frames, status, newest_frame = progress.frames, progress.status, progress.newest
        except NotReadyError:
            frames, status, newest_frame = 0, "preparing", None
        now = time.time()
        with self._lock:
            if frames != self._seen[0]:
                self._seen = frames, now
            age = now - self._seen[1]
        volume = newest(self.what.volumes)
        record = None if self.what.folder is None else read_record(self.what.folder)
        died = record.state == DIED if record is not None else status == "running" and abandoned(self.what.scan)
        over = died or (record is not None and record.over)
        if over and (looked := (died, now // _ADVISED_FOR)) != self._advice[0]:
            self._advice = looked, next_step(self.what.scan)
        return {
            "frames": frames,
            "status": DIED if died else record.state if record is not None and record.over else status,
            "over": over,
            "next": self._advice[1] if over else "",
            "age_s": round(age, 1),
            "newest": newest_frame,
            "free": shutil.disk_usage(self.what.scan.parent).free,
            "volume": None if volume is None else f"{volume.path.name} {volume.changed_ns}",
            "now": now,
            "skipped_lines": self.events.skipped,
        }

    def _open(self) -> Recording:
        if self._recording is None:
            self._recording = Recording(self.what.scan)
        return self._recording

    def _newest_volume(self) -> ShownVolume:
        file = newest(self.what.volumes)
        if file is None:
            raise DataError("There is no volume yet.")
        if self._volume is None or self._volume_file != file:
            before, self._volume = self._volume, None
            if before is not None:
                before.close()
            self._volume, self._volume_file = ShownVolume(file.path), file
            self._thread.submit(self._read_more)
        return self._volume

    def _read_more(self) -> None:
        if self._volume is not None and self._volume.read_more():
            self._thread.submit(self._read_more)
