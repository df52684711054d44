"""The instrument in a script: devices that stay connected over many scans, and the results of these scans."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from beamline.config.beam import NoMonochromator
from beamline.config.load import NO_DECISIONS, NO_LIVE, Config, changed, load, override_of
from beamline.core.errors import ConfigError, DataError, refuse_wrong_arguments
from beamline.core.events import Event, RunDone, ScanDone
from beamline.core.recon_events import ReconDone
from beamline.core.run_result import RunResult
from beamline.core.sinks import sentence
from beamline.core.stop import StopRequest, stop_signals, to_stderr
from beamline.core.text import count, size
from beamline.instrument import connect as devices
from beamline.scan.live_process import Commands, commands_of
from beamline.scan.queue_plan import PlannedScan, QueuePlan
from beamline.scan.queue_planning import plan_queue
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from drivers.in_beam import Ask
from recon.base.greys import grey, html
from recon.base.registry import loaded

Say = Callable[[str], None]

_OF_A_SCAN = ("roi", "binning", "readout")  # settings of the camera that every scan sets itself


class ScanResult(RunResult):
    """Result of a scan for scripts and notebooks: a `RunResult` that a notebook shows as a picture with a table."""

    def _repr_html_(self) -> str:
        """HTML for a notebook: the middle projection as counts, and the results of the scan and of its monitor."""
        flags = [(check, level, n) for check, levels in self.flags.items() for level, n in levels.items()]
        facts = {
            "scan": f"{self.status}, {count(self.n_frames, 'frame')}, {size(self.bytes)}, {self.seconds:.1f} s",
            "missing": str(len(self.missing)),
            "with an alarm": str(self.alarmed_frames),
            "flagged": ", ".join(f"{check} {count(n, 'frame')} ({level})" for check, level, n in flags) or "none",
            "faults": " ".join(self.reference_faults) or "none",
            "file": str(self.path),
        }
        try:
            with open_scan(self.path) as source:
                views = source.table.views
                pixels, (low, high) = grey(source.read([int(views[views.size // 2])])[0])
        except (DataError, IndexError) as error:  # the file was moved, or it has no projection
            return html(self.sample or "scan", np.zeros((1, 1), np.uint8), {**facts, "picture": str(error)})
        return html(self.sample or "scan", pixels, {**facts, "grey": f"black {low:.4g}, white {high:.4g} counts"})


class Instrument:
    """A connected instrument, made by `connect`. The devices are closed at the end of a `with` block.

    Attributes:
        config: the configuration of the devices.
        last: result of the newest scan, even if that scan raised an error; None before the first scan, or if the newest
            scan took no frame.
    """

    def __init__(self, config: Config, connected: devices.ConnectedDevices, say: Say | None = to_stderr) -> None:
        self.config = config
        self.last: ScanResult | None = None
        self._devices, self._say = connected, say
        self._open, self._one_at_a_time = True, threading.Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all ports and the camera. A second call of `close` does nothing."""
        self._open = False
        self._devices.close()

    def scan(
        self,
        *,
        sample: str | None = None,
        energy_kev: float | None = None,
        set: Mapping[str, object] | None = None,
        output: str | Path | None = None,
        live: bool = True,
        stop: StopRequest | None = None,
        on_event: Callable[[Event], None] | None = None,
    ) -> ScanResult:
        """Run a scan in the same way as `beamline scan`: in a new folder, with a check of every frame, and with a file
        that stays readable after a failure.

        The first Ctrl-C stops the scan cleanly, and the second Ctrl-C aborts it. After a stop or an abort, `scan`
        raises an error, so that a loop over several samples ends, too. If this function runs in another thread than the
        main thread, use `stop` instead of Ctrl-C, because Python delivers signals only to the main thread.

        Args:
            sample: name of the sample, which is written to the file and into the folder's name; None: the configured
                name.
            energy_kev: energy of the beam, written to the file. If a monochromator is configured, the monochromator
                moves to this energy.
            set: configuration values for this scan only, such as {"scan.angles.views": 90}.
            output: folder in which the run's folder is created; None: `storage.folder`.
            live: False: without a live reconstruction, even if `recon.live` is on.
            stop: a `StopRequest`, with which another thread can stop or abort the scan.
            on_event: function that gets every event of the run, called in a separate thread.

        Raises:
            ConfigError: a value is wrong, exceeds a limit, or belongs to a key that only `connect` can apply. Nothing
                has moved.
            DeviceError: a device failed.
            DataError: frames are missing, or the disk failed.
            ReferencesError: darks or flats cannot be used.
            ScanStopped: Ctrl-C, `stop`, or a check of the monitor ended the scan; ScanAborted: the scan was aborted.

        After an error during the scan, the frames taken so far are in the file, which `last` names. If the scan ends
        early because further projections would not improve the volume (`scan.decide`), no error is raised.
        """
        refuse_wrong_arguments(Instrument.scan, locals())
        if not self._one_at_a_time.acquire(blocking=False):
            raise ConfigError("a scan of this instrument is still running: wait until it ends. Nothing was started.")
        try:
            config = self._config_of(sample, energy_kev, set or {})
            return self._run(config, output, live, stop or StopRequest(), on_event)
        finally:
            self._one_at_a_time.release()

    def _config_of(self, sample: str | None, energy_kev: float | None, set: Mapping[str, object]) -> Config:
        if not self._open:
            raise ConfigError("the instrument was closed: call `connect` again. Nothing was started.")
        moved = not isinstance(self.config.devices.monochromator, NoMonochromator)
        named = {"sample.name": sample, "scan.energy" if moved else "optics.energy_kev": energy_kev}
        wanted = {**set, **{key: value for key, value in named.items() if value is not None}}
        config = changed(self.config, [override_of(key, value) for key, value in wanted.items()])
        if _of_devices(config) != _of_devices(self.config):
            raise ConfigError(
                f"{', '.join(wanted)}: at least one of these keys belongs to devices that are open, so a new value "
                "would have no effect. Give such a key to `connect` instead. A single scan can change angles, "
                "times, optics, checks, and the camera's roi, binning and readout. Nothing was started."
            )
        return config

    def _run(
        self, config: Config, output: str | Path | None, live: bool, stop: StopRequest,
        on_event: Callable[[Event], None] | None,
    ) -> ScanResult:  # fmt: skip
        self.last, ends = None, list[ScanDone | ReconDone]()

        def remember(event: Event) -> None:
            if isinstance(event, ScanDone | ReconDone):
                ends.append(event)

        def say(event: Event) -> None:
            if self._say is not None and not isinstance(event, RunDone) and (text := sentence(event)):
                self._say(text)

        if not live and config.scan.decide != "off" and self._say is not None:
            self._say(NO_DECISIONS.format(config.scan.decide))
        config = config if live else changed(config, NO_LIVE)
        commands = commands_of(config) if live else Commands()
        if commands.remark and self._say is not None:
            self._say(commands.remark)
        try:
            with stop_signals(stop):
                run_scan(
                    config, None if output is None else Path(output),
                    [remember, say, *([on_event] if on_event else [])], stop,
                    live=commands, instrument=self._devices,
                )  # fmt: skip
        finally:
            self.last = _result(ends)
        assert self.last is not None
        return self.last


def connect(
    config: str | Path, *, set: Mapping[str, object] | None = None, ask: Ask | None = None,
    say: Say | None = to_stderr,
) -> Instrument:  # fmt: skip
    """Open every device of a configuration. Nothing moves.

    Args:
        config: path of the configuration file.
        set: values that replace values of the file, such as {"scan.angles.views": 90}.
        ask: function that asks the operator to move the shutter or the sample by hand, and returns when the operator
            has done it; None: the operator is asked at the terminal.
        say: function that gets each message that a command would print, for example `print` or the `info` of a logger;
            None: no messages.

    Raises:
        ConfigError: the configuration is wrong; the message lists every fault with file, line, key and allowed values.
        DeviceError: a device does not answer. `connect` closes the devices that it had already opened.
    """
    refuse_wrong_arguments(connect, locals())
    read = load(config, [override_of(key, value) for key, value in (set or {}).items()])
    return Instrument(read, devices.connect(read, ask=ask), say)


def scan(
    config: str | Path, *, set: Mapping[str, object] | None = None, ask: Ask | None = None,
    say: Say | None = to_stderr, **of_scan: Any,
) -> ScanResult:  # fmt: skip
    """Connect, run one scan, and close the devices.

    Arguments and errors are those of `connect` and `Instrument.scan`. `set` applies to the connection and to the scan,
    so it can also change how the devices are opened.
    """
    with connect(config, set=set, ask=ask, say=say) as instrument:
        return instrument.scan(**of_scan)


def plan(
    scans: Sequence[str | Path | Mapping[str, object] | Generator[Any, Any, Any]], *,
    set: Mapping[str, object] | None = None, output: str | Path | None = None, rehearse: bool = False,
    live: bool = True,
) -> QueuePlan:  # fmt: skip
    """Plan several scans, as `beamline scan A B --dry-run` does: which of them can run, how long they take, and what
    they need.

    No device is used. If a scan cannot run, the other scans are still planned. Planning a hundred scans takes less than
    a second, not counting the import.

    Args:
        scans: each is a configuration file, a table of scans (.csv), a row of a table of scans as a mapping, such as
            {"config": "my.yaml", "sample.name": "cell_1", "scan.exposure_s": 0.1}, or a plan of bluesky, such as
            `fly(scan)`. The function reads a plan of bluesky to its end without running it; bluesky cannot run that
            plan object afterwards.
        set: values that replace values in all configurations, such as {"scan.angles.views": 90}.
        output: folder in which the scans would create the folders of their runs; None: `storage.folder`.
        rehearse: plan a real configuration with simulated devices.
        live: False: without live reconstructions, even if `recon.live` is on.

    Returns:
        A plan. The `scans` of the plan are in the order of the argument. Each scan has `valid`, `faults` (each with
        message, file and line), and `needs`: `duration` (s) with its `parts`, `n_frames`, `total_bytes`, `dose_gy`, and
        what the `operator` has to do. The `needs` of the plan itself are the sums over the scans that can run.

    Raises:
        ConfigError: an argument has the wrong type. An error in a single scan raises no exception: the `faults` of the
            scan list the error.
    """
    refuse_wrong_arguments(plan, locals())
    described = list[Path | Mapping[str, object] | PlannedScan]()
    for each in scans:
        if isinstance(each, Generator):
            described += loaded("beamline.bluesky.estimate").scans_of(each)
        else:
            described.append(Path(each) if isinstance(each, str) else each)
    return plan_queue(
        described, [override_of(key, value) for key, value in (set or {}).items()],
        place=None if output is None else Path(output), rehearse=rehearse,
        no_live=None if live else lambda sentence: None,
    )  # fmt: skip


def _of_devices(config: Config) -> Mapping[str, Any]:
    """The part of a configuration that opens devices."""
    used = config.model_dump(mode="json", include={"devices", "simulation"})
    camera = {name: value for name, value in used["devices"]["camera"].items() if name not in _OF_A_SCAN}
    pitch = None if config.simulation is None else config.optics.pixel_size_um
    return {**used, "devices": {**used["devices"], "camera": camera}, "pitch": pitch}


def _result(events: Sequence[ScanDone | ReconDone]) -> ScanResult | None:
    """The result of a scan, taken from its events. None if the scan ended before its file was made."""
    scan = next((event for event in events if isinstance(event, ScanDone)), None)
    recon = next((event for event in events if isinstance(event, ReconDone)), None)
    if scan is None:
        return None
    return ScanResult(**{**vars(scan.result), "recon": None if recon is None else recon.values})
