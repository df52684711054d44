"""Process variables of the newest run in a folder, over PVAccess (p4p). With --control clients can control the scan."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from beamline.core.errors import BeamlineError, ConfigError, DataError, user_message
from beamline.core.text import one_line
from beamline.page.followed_run import LONGEST, FollowedRun, RunValues, Severity, Stamp, choice_of
from beamline.plan.passes import Choice
from beamline.scan.control import SentCommand, Verb, ask
from beamline.scan.runs import newest

SHOWN = [each for each in fields(RunValues) if each.name not in ("angle", "flag_names", "flag_counts")]
"""The values of a run that are process variables."""
_DEVICE, _UNDEFINED = 1, 6  # alarm_t.status of EPICS's normative types
_TYPES = {"str": "s", "int": "l", "float": "d", "tuple[str, ...]": "as", "tuple[float, ...]": "ad"}


class RunServer:
    """Serves the newest run of a folder until the server is closed. If a newer run begins, the server switches to it.

    Args:
        prefix: prefix of each name, such as "2bma:splatline:".
        address: network address at which the server listens.
        control: True if the server accepts commands and decisions from everybody who can reach the address.
        say: function that gets a line of text for each command. now: a clock in s since the Unix epoch.

    Raises:
        ConfigError: p4p is not installed.
        DataError: the server cannot listen at this address.
    """

    def __init__(
        self,
        runs: Path,
        prefix: str,
        address: str,
        control: bool,
        say: Callable[[str], None],
        now: Callable[[], float] = time.time,
    ) -> None:
        try:
            from p4p.nt import NTScalar
            from p4p.server import Server, StaticProvider
            from p4p.server.thread import SharedPV
        except ImportError as error:
            raise ConfigError(
                f'EPICS needs p4p, which cannot be loaded here ({error}): pip install "splatline[epics]". Nothing was '
                "started."
            ) from error
        self._say, self._now, self._beats = say, now, 0
        self._run = FollowedRun(runs, now)
        # process variables (PVs) whose clients wait, with the operations of the clients
        self._asked: deque[tuple[Any, Any, SentCommand]] = deque()
        provider, self._shown = StaticProvider("splatline"), dict[str, Any]()
        for each in SHOWN:
            about = {"display.description": each.metadata["about"], "display.units": each.metadata["unit"]}
            kind = NTScalar(_TYPES[str(each.type)], display=True)
            initial = _posted(each.default, self._run.stamped.stamp(each.name))
            self._shown[each.name] = pv = SharedPV(nt=kind, initial={**initial, **about})
            provider.add(prefix + each.metadata["name"], pv)
        started = Stamp(now())
        self._heartbeat = SharedPV(nt=NTScalar("l"), initial=_posted(0, started))
        provider.add(prefix + "Heartbeat", self._heartbeat)
        untold = _posted(False, started)
        self._verbs = {verb: SharedPV(nt=NTScalar("?"), initial=untold) for verb in (Verb if control else ())}
        for verb, pv in self._verbs.items():
            pv.put(self._verb(verb))
            provider.add(f"{prefix}{verb.value.capitalize()}Scan", pv)
        # kept in a list, because a PV without a reference loses its handler
        self._decide = SharedPV(nt=NTScalar("s"), initial=_posted("", started))
        self._decide.put(self._take_answer)
        if control:
            provider.add(prefix + "Decide", self._decide)
        # p4p would listen at the addresses of the environment, too.
        others = {name: value for name, value in os.environ.items() if name.startswith("EPICS") and "INTF" not in name}
        try:
            conf = {**others, "EPICS_PVAS_INTF_ADDR_LIST": address}
            self._server = Server(providers=[provider], conf=conf, useenv=False)
        except RuntimeError as error:
            raise DataError(f"{address} cannot be used: {error}. Nothing was started.") from error

    @property
    def configuration(self) -> dict[str, str]:
        """Addresses and ports of the server, as EPICS names them."""
        return dict(self._server.conf())

    def look(self) -> None:
        """Answer clients whose commands are done. Then read the state of the run, and post every value that has
        changed, with its time and its alarm."""
        for _ in range(len(self._asked)):
            self._answer(*self._asked.popleft())
        before, now = self._run.stamped, self._run.look()
        for each in SHOWN:
            value, stamp = getattr(now.values, each.name), now.stamp(each.name)
            known = getattr(before.values, each.name)
            same = value == known or (value != value and known != known)  # NaN is not equal to itself
            if not same or stamp != before.stamp(each.name):
                self._shown[each.name].post(_posted(value, stamp))
        self._beats += 1
        self._heartbeat.post(_posted(self._beats, Stamp(self._now())))

    def close(self) -> None:
        self._server.stop()
        self._run.close()

    def _verb(self, verb: Verb) -> Callable[[Any, Any], None]:
        """The handler of a PV for a command: writing true sends the command to the run at once, and the PV becomes
        false again. `look` answers the client when the command is done, so a command never waits for another one."""

        def put(pv: Any, op: Any) -> None:
            if bool(op.value()):
                self._send(pv, op, lambda: verb)
            else:
                op.done()

        return put

    def _take_answer(self, pv: Any, op: Any) -> None:
        """The handler of the PV for decisions. A client writes one of the options that the scan offers, while the scan
        waits for a decision."""
        self._send(pv, op, lambda: choice_of(self._run.stamped.values, op.value().raw.value))

    def _send(self, pv: Any, op: Any, verb_of: Callable[[], Verb | Choice]) -> None:
        """Send a command, or a decision, to the run at once. `look` answers the client later."""
        try:
            verb = verb_of()
            self._say(f"{verb} from {op.peer()}")
            self._asked.append((pv, op, ask(newest(self._run.runs), verb)))
        except (BeamlineError, OSError) as error:
            self._end(pv, op, error)

    def _answer(self, pv: Any, op: Any, asked: SentCommand) -> None:
        """Answer the client of a command that is done. If the command is not done yet, the client waits for the next
        call of `look`."""
        try:
            done = asked.state() is not None
        except (BeamlineError, OSError) as error:
            self._end(pv, op, error)
            return
        if done:
            self._end(pv, op)
        else:
            self._asked.append((pv, op, asked))

    def _end(self, pv: Any, op: Any, error: Exception | None = None) -> None:
        """Restore the value that a PV had before the client wrote to it, with the error as its alarm, and answer the
        client."""
        stamp = Stamp(self._now(), *(() if error is None else (Severity.MAJOR, user_message(error))))
        pv.post(_posted("" if pv is self._decide else False, stamp))
        op.done(error=stamp.message or None)


def _posted(value: Any, stamp: Stamp) -> dict[str, Any]:
    """A value with its time and alarm, in the fields of an NTScalar."""
    seconds = math.floor(stamp.time)
    return {
        "value": one_line(value, LONGEST) if isinstance(value, str) else value,
        "timeStamp.secondsPastEpoch": seconds,
        "timeStamp.nanoseconds": min(999_999_999, round(1e9 * (stamp.time - seconds))),
        "alarm.severity": int(stamp.severity),
        "alarm.status": _UNDEFINED if stamp.severity is Severity.INVALID else _DEVICE if stamp.severity else 0,
        "alarm.message": one_line(stamp.message, LONGEST),
    }
