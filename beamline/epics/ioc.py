"""Process variables of the newest run of a folder, by PVAccess (p4p); with --control also the verbs to it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from beamline.core.errors import BeamlineError, ConfigError, DataError, user_message
from beamline.epics.values import RunValues
from beamline.page.run_files import Reader, watched
from beamline.scan.control import Verb, tell
from beamline.scan.runs import newest
from beamline.storage.hdf5 import NotReadyError

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
