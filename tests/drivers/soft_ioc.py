"""A soft IOC in this process: simulated records and variables over PVAccess (p4p)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import pytest

from drivers.base.clock import Clock
from drivers.epics.channel import PvValue
from simulators.devices.clock import VirtualClock
from simulators.wires.epics.wire import CHOICES, MotorRecord

PREFIX = "T:"


class TickingClock(VirtualClock):
    """A virtual clock that calls who wants to know when time has passed."""

    def __init__(self) -> None:
        super().__init__()
        self.ticked: list[Callable[[], None]] = []

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        for tell in self.ticked:
            tell()


class Fields(Protocol):
    """What a soft IOC serves: a simulated record, or variables."""

    @property
    def suffixes(self) -> list[str]: ...

    def read(self, suffix: str) -> PvValue: ...

    def write(self, suffix: str, value: float | str) -> None: ...


@dataclass
class Variables:
    """Single process variables; `choices` of those that are choices. `follow`: called after a write."""

    values: dict[str, float | str]
    choices: dict[str, tuple[str, ...]] = field(default_factory=dict)
    severity: int = 0
    follow: Callable[[str, float | str], None] = lambda name, value: None

    @property
    def suffixes(self) -> list[str]:
        return list(self.values)

    def read(self, suffix: str) -> PvValue:
        return PvValue(self.values[suffix], "", self.severity)

    def write(self, suffix: str, value: float | str) -> None:
        self.values[suffix] = value
        self.follow(suffix, value)


class PvaIoc:
    """Serves fields under a prefix. `stop` ends it, as a computer that is switched off."""

    def __init__(self, served: Fields, prefix: str = PREFIX) -> None:
        from p4p.nt import NTEnum, NTScalar
        from p4p.server import Server, StaticProvider
        from p4p.server.thread import SharedPV

        self._served, self._pvs, self._last = served, dict[str, Any](), dict[str, PvValue]()
        provider = StaticProvider("soft ioc")
        for suffix in served.suffixes:
            value = served.read(suffix)
            choices = _choices(served).get(suffix)
            if choices:
                pv = SharedPV(nt=NTEnum(), initial={"index": int(value.value), "choices": list(choices)})
            else:
                pv = SharedPV(nt=NTScalar("s" if isinstance(value.value, str) else "d"), initial=value.value)
            pv.put(self._putter(suffix))
            self._pvs[suffix] = pv
            provider.add(prefix + suffix, pv)
        self._server = Server(
            providers=[provider],
            conf={
                "EPICS_PVAS_INTF_ADDR_LIST": "127.0.0.1",
                "EPICS_PVA_SERVER_PORT": "0",
                "EPICS_PVA_BROADCAST_PORT": "0",
            },
            useenv=False,
        )
        self.tell()

    @property
    def port(self) -> str:
        return str(self._server.conf()["EPICS_PVAS_SERVER_PORT"])

    def tell(self) -> None:
        """Post what has changed."""
        for suffix, pv in self._pvs.items():
            now = self._served.read(suffix)
            if now != self._last.get(suffix):
                self._last[suffix] = now
                key = "value.index" if suffix in _choices(self._served) else "value"
                value = int(now.value) if key != "value" else now.value
                pv.post({key: value, "alarm.severity": now.severity})

    def stop(self) -> None:
        self._server.stop()

    def _putter(self, suffix: str) -> Callable[[Any, Any], None]:
        def put(pv: Any, operation: Any) -> None:
            value = operation.value()
            try:
                raw = getattr(value, "raw", value)
                choice = suffix in _choices(self._served)
                self._served.write(suffix, float(raw.value.index) if choice else _plain(value))
                self.tell()
            except Exception as error:  # whatever it is: the client waits for an answer
                operation.done(error=str(error))
            else:
                operation.done()

        return put


def _plain(value: Any) -> float | str:
    return str(value) if isinstance(value, str) else float(value)


def _choices(served: Fields) -> dict[str, tuple[str, ...]]:
    return served.choices if isinstance(served, Variables) else CHOICES


@contextmanager
def serve_pva(served: Fields, clock: TickingClock, patch: pytest.MonkeyPatch) -> Iterator[PvaIoc]:
    """Serve for a client that takes its addresses from the environment."""
    ioc = PvaIoc(served)
    clock.ticked.append(ioc.tell)
    patch.setenv("EPICS_PVA_NAME_SERVERS", f"127.0.0.1:{ioc.port}")
    patch.setenv("EPICS_PVA_AUTO_ADDR_LIST", "NO")
    try:
        yield ioc
    finally:
        clock.ticked.remove(ioc.tell)
        ioc.stop()


def record_of(clock: Clock, line: Any, **build: Any) -> MotorRecord:
    """A record with these options of its build."""
    from simulators.wires.epics.wire import EpicsBuild

    return EpicsBuild(**build).controller(clock, line)
