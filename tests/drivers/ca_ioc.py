"""A soft IOC for Channel Access (caproto) as a separate program: a motor record in real time, and some variables.

Prints the port that it listens at, once it listens.
"""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any

from caproto import ChannelType
from caproto.server import PVGroup, pvproperty, run

from drivers.base.clock import SystemClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.epics.wire import CHOICES
from tests.drivers.soft_ioc import PREFIX, Fields, Variables, record_of
from tests.free_ports import free_ports

BLADE = ("Closed", "Open")


def _field(served: Fields, suffix: str, choices: tuple[str, ...]) -> Any:
    async def get(group: Any, instance: Any) -> Any:
        now = served.read(suffix)
        await instance.alarm.write(severity=now.severity)
        return int(now.value) if choices else now.value

    async def put(group: Any, instance: Any, value: Any) -> Any:
        if value == 666:
            os._exit(0)  # the computer of the IOC is switched off
        wanted = choices.index(value) if choices else value
        with suppress(KeyError):  # caproto puts what it has got, too, also where nobody can
            if wanted != served.read(suffix).value:
                served.write(suffix, wanted)

    first = served.read(suffix).value
    kind = ChannelType.ENUM if choices else ChannelType.STRING if isinstance(first, str) else ChannelType.DOUBLE
    start = choices[int(first)] if choices else first
    more = {"enum_strings": choices} if choices else {}
    return pvproperty(value=start, name=suffix, dtype=kind, get=get, put=put, **more)


def _served(served: Fields, choices: dict[str, tuple[str, ...]], prefix: str) -> dict[str, Any]:
    fields = {f"pv{i}": _field(served, name, choices.get(name, ())) for i, name in enumerate(served.suffixes)}
    return type("Group", (PVGroup,), fields)(prefix=prefix).pvdb


if __name__ == "__main__":
    (port,) = free_ports(1)
    os.environ["EPICS_CA_SERVER_PORT"] = str(port)

    async def say_port(library: object) -> None:
        print(port, flush=True)

    clock = SystemClock()
    broken = Variables({"broken": 1.0}, severity=3)
    variables = Variables({"number": 1.5, "text": "mm", "blade": 0.0}, {"blade": BLADE})
    pvs = _served(record_of(clock, TriggerLine(clock)), CHOICES, f"{PREFIX}m1")
    pvs |= _served(variables, variables.choices, PREFIX) | _served(broken, {}, PREFIX)
    run(pvs, interfaces=["127.0.0.1"], log_pv_names=False, startup_hook=say_port)
