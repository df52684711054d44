"""Looking at scans, finished or running: the monitor's verdict, the frames, the volume that grows."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from beamline.config.load import load, override_of
from beamline.config.monitor import configured_checks, reference_limits
from beamline.core.errors import DataError, refuse_wrong_arguments
from beamline.core.files import SCAN, parts_of
from beamline.monitor.checks import CHECKS
from beamline.page.run_files import watched
from beamline.page.volume import newest
from beamline.projections.replay import ScanVerdict, frames_of, replay, verdict
from beamline.scan.runs import describe
from beamline.scan.states import State
from beamline.storage.interrupted import scan_file
from beamline.storage.parts import JOINED
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import NotReadyError, open_scan
from beamline.storage.volumes.files import opened_volume
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame
from recon.base.volume import Volume

_PATIENCE = 120.0  # real s to wait for the begin of a followed scan
_POLL = 0.25  # real s


def monitor(
    path: str | Path, *, config: str | Path | None = None, set: Mapping[str, object] | None = None, follow: bool = False
) -> ScanVerdict:
    """The findings of the monitor's checks on every frame of a scan of any format, as `beamline monitor` prints them.

    Args:
        path: a scan file, or the folder of a run.
        config: file whose sections `monitor` and `references` give the limits; None: those of a new scan.
        set: values that replace those of `config`.
        follow: wait for the end of a scan that still runs.

    Raises:
        ConfigError: `config` is wrong. DataError: no scan, or one that died.
    """
    refuse_wrong_arguments(monitor, locals())
    checks, limits = CHECKS, None
    if config is not None:
        read = load(config, [override_of(key, value) for key, value in (set or {}).items()])
        checks, limits = configured_checks(read.monitor), reference_limits(read.references)
    with _opened(scan_file(path), follow) as source:
        return verdict(source, list(replay(source, checks, follow=SystemClock() if follow else None)), limits)


def stream(path: str | Path, *, follow: bool = True) -> Iterator[Frame]:
    """Every frame of a scan as it is stored, with its kind, angle and time; of a running scan until its end.

    Frames are counts: `frame.counts` uint16 [row, col]. It only reads: a slow reader does not slow the scan down. But
    in the scan's own program, reading and writing wait for each other: read a fast scan from another program.

    Args:
        path: a scan file, or the folder of a run (its newest part). It may not exist yet.
        follow: False: only the present frames.

    Raises:
        DataError: no scan, none that begins within 120 s, or one that died.
    """
    refuse_wrong_arguments(stream, locals())
    path = Path(path)
    place = parts_of(path)[-1] / SCAN if path.is_dir() and not (path / JOINED).is_file() else scan_file(path)
    with _opened(place, follow) as source:
        for frame, _ in frames_of(source, follow=SystemClock() if follow else None):
            yield frame


def volumes(run: str | Path) -> Iterator[Volume]:
    """The live volume of a run after each update, and finally the finished one; ends with the run.

    Args:
        run: its folder. A run that is over gives its last volume.

    Raises:
        DataError: no folder of a run.
    """
    refuse_wrong_arguments(volumes, locals())
    folder, shown = Path(run), None
    watch = watched(folder)
    while True:
        over = describe(folder).state in _OVER  # asked before the volume, so that none is missed
        newest_volume = newest(watch.volumes)
        if newest_volume is not None and newest_volume != shown:
            with (
                suppress(DataError),
                opened_volume(newest_volume.path) as record,
            ):  # the next volume is taking its place
                volume = replace(record.volume, data=np.array(record.volume.data))
                shown = newest_volume
            if shown is newest_volume:
                yield volume
        if over:
            return
        time.sleep(_POLL)


_OVER = frozenset({"died", *(state.value for state in State if state.ended)})


def _opened(path: Path, follow: bool) -> ScanSource:
    """The scan; with `follow` it waits until there is one."""
    deadline = time.monotonic() + _PATIENCE
    while True:
        try:
            return open_scan(path, follow=follow)
        except NotReadyError as error:
            if time.monotonic() > deadline:
                raise DataError(f"No scan began in {path} within {_PATIENCE:.0f} s.") from error
            time.sleep(_POLL)
