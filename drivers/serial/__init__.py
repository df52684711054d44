"""Serial lines: framing, ports, transcripts. `serial` is pyserial, and no other module of that name."""

from drivers.base.causes import of_module

try:
    import serial as serial
    from serial import serial_for_url as serial_for_url  # the package `serial` overwrites a part of pyserial
except ImportError as problem:
    raise of_module("serial", "pyserial", problem) from problem
