"""A viewer of a control room, made with pvapy (APS), as a program: viewer.py CHANNEL.

It prints a line for each frame: number, CRC-32 of its pixels, width, height, kind. Each new line of stdin ends it.
"""

import sys
import zlib

import pvaccess

channel = pvaccess.Channel(sys.argv[1], pvaccess.PVA)


def show(value: pvaccess.PvObject) -> None:
    if not value["value"][0]:
        return
    width, height = (each["size"] for each in value["dimension"])
    kind = next((each["value"][0]["value"] for each in value["attribute"] if each["name"] == "Kind"), "-")
    pixels = value["value"][0]["ushortValue"]
    print(value["uniqueId"], zlib.crc32(pixels.tobytes()), width, height, kind, flush=True)


channel.monitor(show, "")
print("ready", flush=True)
sys.stdin.readline()
channel.stopMonitor()
