"""Packets of Zaber ASCII with their checksums, from zproto's tests and captured from the vendor's library."""

from __future__ import annotations

VECTORS = (
    "/:00",
    "/1:CF",
    "/0 1:7F",
    "/2 1:7D",
    "/0 0 5:2B",
    "/1 tools echo:BF",
    "/get maxspeed:49",
    "/2 0 5 get maxspeed:52",
    "/1 0 01 trigger 1 when 1 dist 1000:C1",
    "/1 1 19 move abs 1000:E6",
    "/1 1 21 home:32",
    "/1 1 22 stop:14",
    "/1 1 25:F7",
    "/0 0 27 stop:11",
    "@01 1 OK IDLE -- 0:8C",
    "@01 0 RJ IDLE -- BADCOMMAND:F5",
)
