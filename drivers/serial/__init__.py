"""Serial lines: framing, ports, transcripts. `serial` is pyserial, and no other module of that name."""

from drivers.base.errors import DeviceError

try:
    import serial as serial
    from serial.tools import list_ports as list_ports

    serial.serial_for_url  # noqa: B018 - the package `serial` writes over parts of pyserial alone
except (ImportError, AttributeError) as problem:
    raise DeviceError(
        "serial ports",
        f"the module `serial` is not that of pyserial ({problem})",
        advice="PyPI's package `serial` has taken its place, or a serial.py or folder of yours has: rename yours, or "
        "`pip uninstall serial`, then `pip install --force-reinstall pyserial`",
        state="Nothing was sent",
    ) from problem
