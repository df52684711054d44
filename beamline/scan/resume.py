"""Resume: continues a run that was killed, failed, stopped or aborted. The missing frames go into a new file.

Existing files are only read (after `recover`, if their process was killed), so that stored frames are never at risk.
The new part gets a folder like that of a run, inside the folder of the run: `part-2`, `part-3` ... The file `joined.h5`
next to the first file joins all parts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.config.load import NO_LIVE, Config, changed, load, resolved_yaml
from beamline.core.errors import ConfigError, DataError
from beamline.core.files import CONFIG, EVENTS, JOINED, SCAN, create_part, parts_of
from beamline.plan.plan import ScanPlan
from beamline.scan.preflight import ReadyScan
from beamline.scan.runs import end_record
from beamline.storage import datasets, hdf5
from beamline.storage.interrupted import is_ride, n_still_to_take, offset_taken, still_to_take
from beamline.storage.parts import (
    end_references_missing,
    files_with_frames,
    is_joined,
    join,
    offset_planned,
    views_planned,
)
from beamline.storage.recorded_frames import frames_in
from beamline.storage.recover import Recovered, recover, require_ours
from beamline.storage.run_record import alive
from beamline.storage.writer_lock import WriterLock
from beamline.storage.writers import layout
from drivers.base.frame import FrameKind

_UNTOUCHED = "Nothing was changed."
_IDENTITY = (  # facts about a device that do not change from scan to scan or from day to day
    "model", "identity", "serial", "firmware", "axis", "device", "channel", "counts_per_turn", "vendor", "cameraid",
    "cameraversion",
)  # fmt: skip


@dataclass(frozen=True)
class ResumableRun:
    """A run that can be resumed.

    Attributes:
        run: folder of the run. lock: lock that keeps other processes from recovering or continuing the run. config:
            configuration of the run. parts: files of the run so far, each with at least one frame. views: planned
            projections that are in these files, or that the scan decided to omit. planned: number of projections of the
            whole plan. offset: triggers of the laterally offset projections in these files. offset_missing: number of
            planned laterally offset projections that are missing. choices: the choice after each pass that ended in
            these files, oldest first. choice_due: True if the last pass has ended and no choice was made yet. seconds:
            duration of the files, each from its first frame to its last one. retaken: number of projections in these
            files that were taken again and replace others. end_references: kinds of darks and flats that are missing
            after the projections, if no projection is missing. None: some projections are missing.
        last_frame_time: time of the last frame, s since the Unix epoch.
        left_out: a sentence on each part that is not used.
    """

    run: Path
    lock: WriterLock
    config: Config
    parts: tuple[Path, ...]
    views: frozenset[int]
    planned: int
    last_frame_time: float
    left_out: tuple[str, ...] = ()
    end_references: frozenset[FrameKind] | None = None
    offset: frozenset[int] = frozenset()
    offset_missing: int = 0
    choices: tuple[str, ...] = ()
    choice_due: bool = False
    seconds: float = 0.0
    retaken: int = 0

    @property
    def in_words(self) -> str:
        """The run in one line for people."""
        missing = self.planned - len(self.views)
        if self.end_references is not None:
            kinds = ["offset projections"] if self.offset_missing else []
            kinds += [f"{kind.name.lower()}s" for kind in sorted(self.end_references)]
            all_views = "the projections that were planned" if self.choices else f"{self.planned} projections"
            missing_kinds = " and ".join(kinds)
            return (
                f"Preparing: {self.run} has all {all_views}; the {missing_kinds} that are missing at the end of the "
                "run are taken now"
            )
        if self.choices:  # some projections were omitted by a decision, or are taken twice
            return f"Preparing: {missing} of the projections planned for {self.run} are missing and are taken now"
        return f"Preparing: {self.run} has {len(self.views)} of {self.planned} projections; {missing} are taken now"

    def remaining(self, plan: ScanPlan) -> ScanPlan:
        """The part of the plan that must still be taken."""
        stored = self.views | self.offset
        references = self.end_references
        return replace(plan, stored=stored, choices=self.choices, choice_due=self.choice_due, end_references=references)

    def begin(self, ready: ReadyScan) -> Path:
        """Recover parts whose process was killed, join the parts, and create the folder of the new part.

        Raises:
            ConfigError: plan, frames or devices have changed; nothing was written.
            DataError: a part cannot be recovered, or the parts cannot be joined.
        """
        with hdf5.open_hdf5(self.parts[0]) as first, hdf5.readable(self.parts[0]):
            _require_same_instrument(self.run, first, ready)
        for part in self.parts:
            recover(part)
        if len(self.parts) > 1 and not is_joined(self.run / JOINED):  # needed if the new part takes no frame
            join(self.parts, self.run / JOINED)
        return create_part(self.run)

    def join(self, part: Path) -> tuple[Path, int]:
        """Join all parts, including the new one. Returns the joined file and its number of frames."""
        joined = self.run / JOINED
        return joined, join([*self.parts, part], joined)


class NotJoined(ConfigError):  # noqa: N818 - an outcome, not a defect
    """All frames of the run are recorded, but a file was not closed or the parts are not joined. `recover_run` can do
    both.
    """


class NothingMissing(ConfigError):  # noqa: N818 - likewise
    """The run has all its frames."""


class NoFrame(ConfigError):  # noqa: N818 - likewise
    """The run has no frame."""


@contextmanager
def open_for_resume(run: Path, required_config: Config | None = None) -> Iterator[ResumableRun]:
    """A context that locks the run in this folder, so that no other process can resume it.

    Args:
        required_config: a configuration that must equal that of the run.

    Raises:
        ConfigError: the folder is not a run, another process is working on it, or its configuration differs. Its
            subclasses: NothingMissing, NoFrame, and NotJoined (only `recover_run` is needed). DataError: a file of the
            run cannot be read. In all of these cases nothing was changed.
    """
    if absent := [name for name in (SCAN, CONFIG, EVENTS) if not (run / name).is_file()]:
        raise ConfigError(f"{run} is not the folder of a run: it has no {' and no '.join(absent)}. {_UNTOUCHED}")
    with _locked(run) as lock:
        yield _resumable_run(run, required_config, lock)


@contextmanager
def _locked(run: Path) -> Iterator[WriterLock]:
    """A context in which no other process recovers or continues the run.

    Raises:
        ConfigError: a process is taking, recovering or continuing the run, or the run is write-protected.
    """
    try:
        lock = WriterLock(run / EVENTS, exclusive=True)
    except OSError as error:
        raise ConfigError(
            f"{run} cannot be locked ({error.strerror}): another process is continuing or recovering this run, or "
            f"the run is write-protected. {_UNTOUCHED}"
        ) from None
    try:
        if alive(parts_of(run)[-1]):
            raise ConfigError(f"The scan of {run} is still running: wait until the scan ends, or stop it. {_UNTOUCHED}")
        yield lock
    finally:
        lock.release()


def _resumable_run(run: Path, required_config: Config | None, lock: WriterLock) -> ResumableRun:
    if is_ride(run):
        raise ConfigError(
            f"{run} recorded the scan of another program, which cannot be continued here. `beamline ride` "
            f"records the next scan in a new run. {_UNTOUCHED}"
        )
    files, left_out = _files(run)
    config = load(run / CONFIG, environment={})
    if required_config is not None and not config.recon.live:
        required_config = changed(required_config, NO_LIVE)
    planned, retaken, frame_times, parts, all_closed = 0, 0, list[NDArray[np.float64]](), list[Path](), True
    for part in files:
        with hdf5.open_hdf5(part) as file, hdf5.readable(part):
            require_ours(part, file)
            for config_to_compare in (config, required_config):
                if config_to_compare is not None:
                    require_same_config(run, file["/entry/record/config"].asstr()[()], config_to_compare)
            if not (angles := views_planned(file)):
                raise DataError(f"The missing projections are unknown, because {part} has no plan. {_UNTOUCHED}")
            planned = angles
            if file[layout.COMMITTED][()]:
                table = frames_in(file)  # this raises an error that names a damaged file
                parts.append(part)
                all_closed = all_closed and bool(file[layout.FINISHED][()])
                frame_times.append(file[layout.TIME][()])
                numbers = table.triggers[table.views]
                retaken += int((numbers >= planned).sum())  # their triggers are counted after those of the plan
    if not parts:
        raise NoFrame(f"{run} has no frame: start the scan again. {_UNTOUCHED}")
    with ExitStack() as opened, hdf5.readable(run):
        open_files = [opened.enter_context(hdf5.open_hdf5(part)) for part in parts]
        missing, choices, choice_due = still_to_take(open_files)
        offset = offset_taken(open_files)
        offset_missing = offset_planned(open_files[0]) - len(offset)
        end_references = None if missing else end_references_missing(open_files)
    if not (missing or offset_missing or end_references):
        _refuse_complete(run, parts, all_closed)
    last_frame_time = max(float(part.max()) for part in frame_times)
    seconds = sum(float(np.ptp(part)) for part in frame_times)
    return ResumableRun(
        run, lock, config, tuple(parts), frozenset(range(planned)) - missing, planned, last_frame_time, tuple(left_out),
        end_references, offset, offset_missing, choices, choice_due, seconds, retaken,
    )  # fmt: skip


def _refuse_complete(run: Path, parts: list[Path], closed: bool) -> None:
    """Raise NothingMissing; or NotJoined, if the run has all of its frames but a file was not closed or joined."""
    whole = f"{run} has all projections, darks and flats that were planned"
    if closed and (len(parts) == 1 or is_joined(run / JOINED)):
        raise NothingMissing(f"{whole}: nothing is missing. {_UNTOUCHED}")
    problem = (
        f"{JOINED} does not have all frames of the {len(parts)} parts of the run" if closed else "a file was not closed"
    )
    raise NotJoined(f"{whole}, but {problem}: `beamline recover {run}` fixes that. {_UNTOUCHED}")


def _files(run: Path) -> tuple[list[Path], list[str]]:
    """The files of the parts, without parts that ended before their first frame; and a sentence on each part that was
    left out."""
    files = files_with_frames(run)
    empty = [part / SCAN for part in parts_of(run) if (part / SCAN).is_file() and part / SCAN not in files]
    return files, [
        f"{scan} is left out, because none of its frames can be read and its {EVENTS} lists no frame." for scan in empty
    ]


def require_same_config(run: Path, stored: str, other: Config, name: str = SCAN) -> None:
    """Raise ConfigError if the configuration differs from that in a file of the run. (The first line of the file is the
    version of the program.)
    """
    stored_lines, lines = stored.splitlines()[1:], resolved_yaml(other).splitlines()[1:]
    differ = next(((a.strip(), b.strip()) for a, b in zip(stored_lines, lines, strict=False) if a != b), None)
    if differ is not None or len(stored_lines) != len(lines):
        difference = " `{}` instead of `{}`".format(*differ) if differ else ""
        raise ConfigError(f"{run} was taken with another configuration:{difference} in its {name}. {_UNTOUCHED}")


def _require_same_instrument(run: Path, stored: h5py.File, ready: ReadyScan) -> None:
    if stored["/entry/record/plan"].asstr()[()] != ready.info.plan:
        raise ConfigError(f"{run} was planned with other angles: was the angle file changed? {_UNTOUCHED}")
    if (frames := stored[layout.DATA].shape[1:]) != tuple(ready.timing.shape):
        raise ConfigError(
            f"{run} has frames of {frames} pixels, but the camera gives {ready.timing.shape}. {_UNTOUCHED}"
        )
    for device, before, now in _devices_differing(stored, ready):
        raise ConfigError(f"{run} was taken with another {device}: {before}; now it is {now}. {_UNTOUCHED}")


def _devices_differing(stored: h5py.File, ready: ReadyScan) -> Iterator[tuple[str, str, str]]:
    """The devices whose identity differs from that in a file: name and both identities of each."""
    for device, description in ready.info.devices.items():
        group = datasets.resolve(stored["/entry/instrument/devices"], device.replace("/", "_")) or {}
        earlier = {key: datasets.text(group[key][()]) for key in group}
        before, now = (
            ", ".join(f"{key} {datasets.text(facts[key])}" for key in _IDENTITY if key in facts) or "none"
            for facts in (earlier, description)
        )
        if before != now:
            yield device, before, now


def recover_run(run: Path, say: Callable[[str], None] = lambda _: None) -> tuple[list[Recovered], list[str]]:
    """Recover every part of a run, and join the parts if there are several. The joined file comes last.

    If the process of the run was killed, the record of the run gets the state of the newest file.

    Args:
        say: function that gets a sentence on the disk space that each file needs, before anything is written.

    Returns:
        The result for each file, and a sentence on each part that was left out.

    Raises:
        ConfigError: a process is taking, recovering or continuing the run.
        DataError: the folder is not a run, or a part cannot be recovered. Earlier parts are recovered.
    """
    with _locked(run) if (run / EVENTS).is_file() else nullcontext():  # no process works on the copies of the files
        files, left_out = _files(run)
        if not files:
            reason = f"has no frame: {left_out[0]}" if left_out else f"is not the folder of a run: it has no {SCAN}."
            raise DataError(f"{run} {reason} {_UNTOUCHED}")
        recovered = [recover(part, say) for part in files]
        if len(parts := [result.path for result in recovered if result.frames]) > 1:
            changed = not is_joined(run / JOINED)
            if changed:
                join(parts, run / JOINED)
            with hdf5.open_hdf5(run / JOINED) as file:
                frames, missing = int(file[layout.COMMITTED][()]), n_still_to_take(file)
                recovered.append(Recovered(run / JOINED, changed, frames, 0, missing))
        end_record(parts_of(run)[-1])
    return recovered, left_out
