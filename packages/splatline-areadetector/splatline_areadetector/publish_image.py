"""ImageServer: frames as areaDetector's NDPluginPva publishes them (NTNDArray), and how many each client missed."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from beamline.core.errors import ConfigError, DataError
from drivers.base.frame import FrameKind
from splatline_areadetector.publish_frames import PublishedFrame

LOCATIONS = {
    FrameKind.PROJECTION: "/exchange/data",
    FrameKind.FLAT: "/exchange/data_white",
    FrameKind.DARK: "/exchange/data_dark",
}
"""Kinds of frames as tomoscan (APS) writes them into the attribute HDF5FrameLocation."""
_CLIENT = re.compile(r"(?P<client>\S+) +(?P<pv>\S+) TX=(?P<sent>\d+) RX=\d+ +\S+ ioid=\d+ MONITOR")
_OVERHEAD = 380  # bytes of an update beside its pixels, about: time, alarm, attributes


def attributes_of(frame: PublishedFrame) -> dict[str, Any]:
    """The NDAttributes of a frame by their names."""
    return {
        "ColorMode": 0,
        "Angle": frame.angle,
        "Kind": frame.kind.name.lower(),
        "HDF5FrameLocation": LOCATIONS.get(frame.kind, ""),
        "AcquireTime": frame.exposure,
    }


@dataclass(frozen=True)
class ClientCount:
    """Frames that a client of the image was sent, and those that it missed, as its queue was full; both about right:
    they come from the bytes on its line."""

    sent: int
    missed: int


class ImageServer:
    """Serves one image by PVAccess until it is closed. A client that is slow, or stands still, loses frames; nobody
    waits for it.

    Args:
        name: of the process variable.
        address: to listen at.
        port: TCP port; None: EPICS_PVAS_SERVER_PORT, else 5075, and any other one where that is taken.

    Raises:
        ConfigError: p4p is not installed.
        DataError: the address or the port cannot be listened at.
    """

    def __init__(self, name: str, address: str, port: int | None) -> None:
        try:
            from p4p.nt import NTNDArray
            from p4p.server import Server, StaticProvider
            from p4p.server.thread import SharedPV
        except ImportError as error:
            raise ConfigError(
                f'Publishing needs p4p, which cannot be loaded here ({error}): pip install "splatline[epics]". Nothing '
                "was started."
            ) from error
        self.name, self._type = name, NTNDArray()
        self._image = SharedPV(initial=self._type.type())
        self._provider = StaticProvider("image")
        self._provider.add(name, self._image)
        try:
            self._server = Server(providers=[self._provider], conf=_configured(address, port), useenv=False)
        except RuntimeError as error:
            raise DataError(f"{address} cannot be listened at: {error}. Nothing was started.") from error
        self.port = int(self._server.conf()["EPICS_PVAS_SERVER_PORT"])
        if port not in (None, 0, self.port):
            self._server.stop()
            raise DataError(
                f"Port {port} of {address} is taken by another program. Give another --port, or none: clients find the "
                "image by its name. Nothing was started."
            )
        self._posted, self._frame_bytes = 0, 0
        self._clients: dict[str, tuple[int, int]] = {}  # frames posted before it came, bytes it was sent by then

    def post(self, frame: PublishedFrame) -> None:
        """Send a frame to all clients, and return at once."""
        value = self._type.wrap(frame.counts, attrib=attributes_of(frame), timestamp=frame.time)
        value["uniqueId"] = frame.unique_id
        value["dataTimeStamp"] = {
            "secondsPastEpoch": math.floor(frame.time), "nanoseconds": int(1e9 * (frame.time % 1)),
        }  # fmt: skip
        if self._frame_bytes not in (0, frame.counts.nbytes):  # another run: bytes do not tell frames any more
            self._clients.clear()
        self._image.post(value)
        self._posted, self._frame_bytes = self._posted + 1, frame.counts.nbytes

    def clients(self) -> Mapping[str, ClientCount]:
        """Frames sent to and missed by each client that is connected now, since the first call that saw it."""
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
    """The environment of EPICS with this address and port in place of its own, to which p4p would add them."""
    conf = {name: value for name, value in os.environ.items() if name.startswith("EPICS_PVA")}
    for name in ("EPICS_PVAS_INTF_ADDR_LIST", "EPICS_PVA_INTF_ADDR_LIST"):
        conf.pop(name, None)
    ports = {} if port is None else dict.fromkeys(("EPICS_PVAS_SERVER_PORT", "EPICS_PVA_SERVER_PORT"), f"{port}")
    return conf | ports | {"EPICS_PVAS_INTF_ADDR_LIST": address}
