"""Serial lines: framing, ports, transcripts. `serial` is pyserial, and no other module of that name."""

from drivers.base.errors import DeviceError

try:
    import serial as serial
    from serial import serial_for_url as serial_for_url  # the package `serial` overwrites a part of pyserial
except ImportError as problem:
    raise DeviceError(
        "serial ports",
        f"the module `serial` is not that of pyserial ({problem})",
        advice="PyPI's package `serial` has taken its place: `pip uninstall serial`, then `pip install "
        "--force-reinstall pyserial`. If it is a serial.py or folder of yours, rename that",
        state="Nothing was sent",
    ) from problem
