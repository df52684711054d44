"""Process variables of the newest run of a folder, by PVAccess (p4p); with --control also the verbs to it."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from beamline.core.errors import BeamlineError, ConfigError, DataError, user_message
from beamline.page.run_files import Reader, watched
from beamline.scan.control import Verb, tell
from beamline.scan.runs import newest
from beamline.storage.hdf5 import NotReadyError


def _pv(name: str, about: str, default: Any, unit: str = "") -> Any:
    return field(default=default, metadata={"pv": name, "about": about, "unit": unit})


@dataclass(frozen=True)
class RunValues:
    """The present values of a run; each field is a process variable, with its name, meaning and unit as metadata.

    Names that tomoscan (APS) has are as there. Numbers are NaN or -1 where they are not known.
    """

    run: str = _pv("Run", "folder of the run", "")
    sample: str = _pv("SampleName", "name of the sample", "")
    file: str = _pv("FileName", "scan file", "")
    state: str = _pv("ScanStatus", "idle, preparing, darks, flats, acquiring, paused, done ...", "idle")
    message: str = _pv("Message", "what the scan said last", "")
    planned: int = _pv("ImagesPlanned", "frames that the scan takes in all", -1)
    exposed: int = _pv("ImagesCollected", "frames exposed", 0)
    stored: int = _pv("ImagesSaved", "frames in the file", 0)
    percent: float = _pv("PercentComplete", "of the frames planned", 0.0, "%")
    rate: float = _pv("FrameRate", "frames a second", math.nan, "Hz")
    data_rate: float = _pv("DataRate", "data a second", math.nan, "MB/s")
    time_left: float = _pv("RemainingTime", "until the last frame", math.nan, "s")
    mean: float = _pv("MeanCounts", "of the newest frame", math.nan, "counts")
    beam: float = _pv("Beam", "last reading of the beam monitor", math.nan)
    warnings: int = _pv("Warnings", "flags of the monitor that warn", 0)
    alarms: int = _pv("Alarms", "flags of the monitor that are alarms", 0)
    last_flag: str = _pv("LastFlag", "check, frame and advice of the last flag", "")
    views: int = _pv("ReconViews", "views in the live volume", 0)
    residual: float = _pv("ReconResidual", "of the views that the live volume has not learnt", math.nan)
    free: float = _pv("DiskFree", "of the disk with the scan file", math.nan, "GB")
    age: float = _pv("FrameAge", "since the last frame came into the file", math.nan, "s")

    def after(self, lines: Iterable[str]) -> RunValues:
        """The values after these further lines of the log."""
        now = self
        for line in lines:
            event = json.loads(line)
            take = _TAKEN.get(str(event.get("event")))
            if take is not None:
                now = replace(now, **take(now, event))
        return now

    def with_file(self, seen: Mapping[str, Any]) -> RunValues:
        """The same with what the file says: `page.run_files.Reader.state`."""
        stored = int(seen["frames"])
        state = seen["status"] if not self.run and seen["status"] != "running" else self.state
        percent = 100.0 * stored / self.planned if self.planned > 0 else self.percent
        return replace(self, stored=stored, percent=percent, state=state, free=seen["free"] / 1e9, age=seen["age_s"])


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _state(now: RunValues, event: Mapping[str, Any]) -> dict[str, Any]:
    if event.get("source") == "recon":  # of the live volume
        return {}
    return {"state": str(event["state"]), "message": str(event.get("message", ""))}


def _frame(now: RunValues, event: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "exposed": int(event["n"]), "rate": _number(event["frames_per_s"]), "data_rate": _number(event["mb_per_s"]),
        "time_left": _number(event["eta_s"]), "mean": _number(event.get("mean")),
    }  # fmt: skip


def _flag(now: RunValues, event: Mapping[str, Any]) -> dict[str, Any]:
    if "check" not in event:  # a rule of the file
        return {}
    alarm = event["level"] == "alarm"
    said = f"{event['check']} {event['level']}, frame {event['frame']}: {event['advice']}"
    return {"alarms": now.alarms + alarm, "warnings": now.warnings + (not alarm), "last_flag": said}


_TAKEN = {
    "run_started": lambda now, event: {
        "run": str(event["folder"]), "sample": str(event["sample"]), "file": str(event["path"]),
        "planned": int(event["n_frames"]),
    },
    "state": _state,
    "frame": _frame,
    "flag": _flag,
    "beam": lambda now, event: {"beam": _number(event["value"])},
    "warning": lambda now, event: {"message": str(event["message"])},
    "snapshot": lambda now, event: {"views": int(event["n_views"]), "residual": _number(event.get("unlearnt"))},
    "scan_done": lambda now, event: {"time_left": 0.0, "rate": math.nan, "data_rate": math.nan},
}  # fmt: skip


PERIOD = 0.5  # s between two looks at the run
_TYPES: dict[str, str] = {"str": "s", "int": "l", "float": "d"}


class RunServer:
    """Serves the newest run of a folder, also one that begins later, until it is closed.

    Args:
        prefix: before each name, such as "2bma:splatline:".
        address: to listen at.
        control: verbs are taken, from everybody who reaches the address.
        say: takes a line for each verb.

    Raises:
        ConfigError: p4p is not installed.
        DataError: the address cannot be listened at.
    """

    def __init__(self, runs: Path, prefix: str, address: str, control: bool, say: Callable[[str], None]) -> None:
        try:
            from p4p.nt import NTScalar
            from p4p.server import Server, StaticProvider
            from p4p.server.thread import SharedPV
        except ImportError as error:
            raise ConfigError(
                'EPICS needs the library p4p: pip install "splatline[epics]". Nothing was started.'
            ) from error
        self._runs, self._say = runs, say
        self._reader: Reader | None = None
        self._values, self._lines, self._beats = RunValues(), 0, 0
        self._busy = threading.Lock()
        provider, self._shown = StaticProvider("splatline"), dict[str, Any]()
        for each in fields(RunValues):
            about = {"display.description": each.metadata["about"], "display.units": each.metadata["unit"]}
            kind = NTScalar(_TYPES[str(each.type)], display=True)
            self._shown[each.name] = pv = SharedPV(nt=kind, initial={"value": each.default, **about})
            provider.add(prefix + each.metadata["pv"], pv)
        self._heartbeat = SharedPV(nt=NTScalar("l"), initial=0)
        provider.add(prefix + "Heartbeat", self._heartbeat)
        self._verbs = {verb: SharedPV(nt=NTScalar("?"), initial=False) for verb in (Verb if control else ())}
        for verb, pv in self._verbs.items():
            pv.put(self._verb(verb))
            provider.add(f"{prefix}{verb.value.capitalize()}Scan", pv)
        try:
            self._server = Server(providers=[provider], conf={"EPICS_PVAS_INTF_ADDR_LIST": address})
        except RuntimeError as error:
            raise DataError(f"{address} cannot be listened at: {error}. Nothing was started.") from error

    @property
    def configuration(self) -> dict[str, str]:
        """Addresses and ports of the server, as EPICS names them."""
        return dict(self._server.conf())

    def look(self) -> None:
        """Look at the run, and post what has changed."""
        now, before = self._read(), self._values
        for each in fields(RunValues):
            value, known = getattr(now, each.name), getattr(before, each.name)
            if value != known and (value == value or known == known):  # NaN is not equal to itself
                self._shown[each.name].post(value)
        self._values = now
        self._beats += 1
        self._heartbeat.post(self._beats)

    def close(self) -> None:
        self._server.stop()
        if self._reader is not None:
            self._reader.close()

    def _read(self) -> RunValues:
        try:
            run = newest(self._runs)
        except ConfigError:
            return self._values  # no run so far
        values = self._values
        what = watched(run)
        if self._reader is None or self._reader.what != what:
            if self._reader is not None:
                self._reader.close()
            self._reader, self._lines, values = Reader(what), 0, RunValues()
        try:
            seen = self._reader.state()
        except (DataError, NotReadyError, OSError):
            return values
        lines = self._reader.events.lines
        values = values.after(lines[self._lines :]).with_file(seen)
        self._lines = len(lines)
        return values

    def _verb(self, verb: Verb) -> Callable[[Any, Any], None]:
        """A handler of a PV: true sends the verb to the run, and the PV is false again."""

        def put(pv: Any, op: Any) -> None:
            if not bool(op.value()):
                op.done()
                return
            self._say(f"{verb} from {op.peer()}")
            try:
                with self._busy:
                    tell(newest(self._runs), verb)
            except (BeamlineError, OSError) as error:
                op.done(error=user_message(error))
            else:
                op.done()

        return put
