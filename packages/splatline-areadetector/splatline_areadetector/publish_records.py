"""RecordServer: the records of a published detector, by Channel Access and PVAccess, in a soft IOC (softioc)."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from beamline.core.errors import ConfigError
from splatline_areadetector.publish_detector import BUSY, Record, Sides, Value


class RecordServer:
    """Serves records until the process ends: EPICS has one IOC a process, which cannot be stopped alone.

    Args:
        prefix: before each name, with its colon.
        address: to listen at.
        asked: takes the name and the value of what a client has written, in another thread.

    Raises:
        ConfigError: softioc is not installed.
    """

    def __init__(
        self, prefix: str, records: Sequence[Record], address: str, asked: Callable[[str, Value], None]
    ) -> None:
        os.environ["EPICS_CAS_INTF_ADDR_LIST"] = os.environ["EPICS_PVAS_INTF_ADDR_LIST"] = address
        os.environ["EPICS_PVAS_SERVER_PORT"] = os.environ["EPICS_PVA_SERVER_PORT"] = "0"  # the image has the usual one
        try:
            from softioc import asyncio_dispatcher, builder, softioc
        except ImportError as error:
            raise ConfigError(
                f"Publishing needs softioc, which cannot be loaded here ({error}): pip install softioc. Nothing was "
                "started."
            ) from error
        self._records: dict[str, Any] = {}
        self._setpoints = set[str]()
        builder.SetDeviceName(prefix.removesuffix(":"))
        for record in records:
            if record.sides is not Sides.SETPOINT:
                self._add(builder, record, f"{record.name}_RBV", None)
            if record.sides is not Sides.READBACK:
                self._add(builder, record, record.name, partial(asked, record.name))
                self._setpoints.add(record.name)
        builder.LoadDatabase()
        softioc.eltc(0)  # EPICS's own lines at the start
        softioc.iocInit(asyncio_dispatcher.AsyncioDispatcher())

    def put(self, name: str, value: Value) -> None:
        """Show a value in a record."""
        record = self._records[name]
        if name in self._setpoints:
            record.set(value, process=False)
        else:
            record.set(value)

    def _add(self, builder: Any, record: Record, name: str, handler: Callable[[Value], None] | None) -> None:
        kind, arguments = _kind_of(record)
        facts: dict[str, Any] = {"initial_value": record.initial}
        if record.length:
            facts["length"] = record.length
        if handler is not None:
            # A put that waits is answered when the readback shows it. Not so where it would wait for frames: softioc
            # has no record of the type busy, and a stop would queue behind it.
            facts |= {"on_update": handler, "always_update": True, "blocking": record.name not in BUSY}
        make = getattr(builder, f"{kind}{'In' if handler is None else 'Out'}")
        self._records[name] = make(name, *arguments, **facts)


def _kind_of(record: Record) -> tuple[str, tuple[str, ...]]:
    """The builder of softioc for a record, without In or Out, and its labels."""
    if record.labels:
        return ("bool" if len(record.labels) == 2 else "mbb"), record.labels
    if isinstance(record.initial, str):
        return ("longString" if record.length else "string"), ()
    return ("a" if isinstance(record.initial, float) else "long"), ()
