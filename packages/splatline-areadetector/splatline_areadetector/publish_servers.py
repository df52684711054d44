"""EPICS servers. One publishes frames as areaDetector's NDPluginPva does (NTNDArray), and counts the frames that each
client missed. The other serves the records of a published detector over Channel Access and PVAccess (softioc)."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from beamline.core.errors import ConfigError, DataError
from splatline_areadetector.publish_detector import BUSY, Record, Sides, Value
from splatline_areadetector.publish_frames import PublishedFrame

_CLIENT = re.compile(r"(?P<client>\S+) +(?P<pv>\S+) TX=(?P<sent>\d+) RX=\d+ +\S+ ioid=\d+ MONITOR")
_OVERHEAD = 380  # approximate bytes of an update besides its pixels: time, alarm, attributes


@dataclass(frozen=True)
class ClientCount:
    """Frames that were sent to a client of the image, and frames that it missed because its queue was full. Both are
    approximate, because they are computed from the bytes sent."""

    sent: int
    missed: int


class ImageServer:
    """Serves one image over PVAccess until it is closed. The server does not wait for clients: a client that is slow or
    stalls loses frames.

    Args:
        name: name of the process variable.
        address: network address for clients.
        port: TCP port; None: EPICS_PVAS_SERVER_PORT, else 5075, and any other one if that is taken.

    Raises:
        ConfigError: p4p is not installed.
        DataError: the address or the port cannot be used.
    """

    def __init__(self, name: str, address: str, port: int | None) -> None:
        try:
            from p4p.nt import NTNDArray
            from p4p.server import Server, StaticProvider
            from p4p.server.thread import SharedPV
        except ImportError as error:
            raise ConfigError(
                f'Install p4p: pip install "splatline[epics]". The package cannot be loaded ({error}). Nothing was '
                "started."
            ) from error
        self.name, self._type = name, NTNDArray()
        self._image = SharedPV(initial=self._type.type())
        self._provider = StaticProvider("image")
        self._provider.add(name, self._image)
        try:
            self._server = Server(providers=[self._provider], conf=_configured(address, port), useenv=False)
        except RuntimeError as error:
            raise DataError(
                f"Clients cannot connect to the address {address}: {error}. Nothing was started."
            ) from error
        self.port = int(self._server.conf()["EPICS_PVAS_SERVER_PORT"])
        if port not in (None, 0, self.port):
            self._server.stop()
            raise DataError(
                f"Another program uses port {port} of {address}. Give another --port, or leave out --port: clients "
                "find the image by its name. Nothing was started."
            )
        self._posted, self._frame_bytes = 0, 0
        self._clients: dict[str, tuple[int, int]] = {}  # frames posted before the client came, bytes sent to it by then

    def post(self, frame: PublishedFrame) -> None:
        """Send a frame to all clients, and return at once."""
        value = self._type.wrap(frame.counts, attrib=frame.attributes, timestamp=frame.time)
        value["uniqueId"] = frame.unique_id
        value["dataTimeStamp"] = {
            "secondsPastEpoch": math.floor(frame.time), "nanoseconds": int(1e9 * (frame.time % 1)),
        }  # fmt: skip
        if self._frame_bytes not in (0, frame.counts.nbytes):  # another run: bytes no longer give frames
            self._clients.clear()
        self._image.post(value)
        self._posted, self._frame_bytes = self._posted + 1, frame.counts.nbytes

    def clients(self) -> Mapping[str, ClientCount]:
        """Frames sent to each connected client and missed by it, since the first call that saw the client."""
        counts = dict[str, ClientCount]()
        for match in _CLIENT.finditer(self._server.tostr(5)):
            if match["pv"] != self.name or not self._frame_bytes:
                continue
            bytes_sent = int(match["sent"])
            posted, before = self._clients.setdefault(match["client"], (self._posted, bytes_sent))
            sent = round((bytes_sent - before) / (self._frame_bytes + _OVERHEAD))
            counts[match["client"]] = ClientCount(sent, max(0, self._posted - posted - sent))
        self._clients = {client: self._clients[client] for client in counts}
        return counts

    def close(self) -> None:
        self._server.stop()


def _configured(address: str, port: int | None) -> dict[str, str]:
    """The environment of EPICS with its address and port replaced, because p4p would add ours to them."""
    conf = {name: value for name, value in os.environ.items() if name.startswith("EPICS_PVA")}
    for name in ("EPICS_PVAS_INTF_ADDR_LIST", "EPICS_PVA_INTF_ADDR_LIST"):
        conf.pop(name, None)
    ports = {} if port is None else dict.fromkeys(("EPICS_PVAS_SERVER_PORT", "EPICS_PVA_SERVER_PORT"), f"{port}")
    return conf | ports | {"EPICS_PVAS_INTF_ADDR_LIST": address}


class RecordServer:
    """Serves records until the process ends. A process can have only one IOC, which cannot be stopped separately.

    Args:
        prefix: prefix of each name, with its colon.
        address: network address for clients.
        asked: called in another thread with the name and the value that a client has written.

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
                f"Install softioc for publishing: pip install softioc. The package cannot be loaded ({error}). "
                f"Nothing was "
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
        softioc.eltc(0)  # so that EPICS prints nothing at the start
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
            # A put with completion is answered when the readback shows the value, except for records that wait for
            # frames: softioc has no record of the type busy, and a stop would queue behind such a put.
            facts |= {"on_update": handler, "always_update": True, "blocking": record.name not in BUSY}
        make = getattr(builder, f"{kind}{'In' if handler is None else 'Out'}")
        self._records[name] = make(name, *arguments, **facts)


def _kind_of(record: Record) -> tuple[str, tuple[str, ...]]:
    """The name of softioc's builder for a record, without In or Out, and the labels."""
    if record.labels:
        return ("bool" if len(record.labels) == 2 else "mbb"), record.labels
    if isinstance(record.initial, str):
        return ("longString" if record.length else "string"), ()
    return ("a" if isinstance(record.initial, float) else "long"), ()
