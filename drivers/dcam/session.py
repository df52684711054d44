"""Session: starts the library, opens one camera and its wait handle, and closes them in reverse order."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from drivers.base.errors import DeviceError
from drivers.dcam import codes, usb
from drivers.dcam.abi import Dcam, DcamError
from drivers.dcam.codes import DcamEvent, Error


class Session:
    """One open camera in the library. A process can have one session at a time.

    Args:
        library: path of the DCAM-API library; None: the installed one.
        index: number of the camera among those that DCAM finds, from 0.
        device: name of the camera in error messages.

    Raises:
        DeviceError: no library, or no camera; nothing stays open.
    """

    def __init__(self, library: Path | None, index: int, device: str) -> None:
        self.dcam = Dcam(library, device)
        self._device = device
        self._steps: list[Callable[[], None]] = []  # close what was opened, in reverse order
        try:
            cameras = self._start()
            if index >= cameras:
                raise DeviceError(
                    device,
                    f"there is no camera {index}",
                    expected=f"an index below {cameras}, the number of cameras that DCAM found",
                    advice="Correct the camera's index in the configuration",
                    state="Nothing was changed",
                )
            self.camera = self.dcam.dev_open(index)
            self._steps.append(lambda: self.dcam.dev_close(self.camera))  # also ends a capture and frees the ring
            self.wait, supported = self.dcam.wait_open(self.camera)
            self._steps.append(lambda: self.dcam.wait_close(self.wait))
            self.events = (DcamEvent.FRAMEREADY | DcamEvent.STOPPED) & supported
        except BaseException:
            with suppress(DcamError):
                self.close()
            raise

    def close(self) -> None:
        """Close everything, also if a step fails; may be called again.

        Raises:
            DcamError: the first failure. An unplugged camera is not a failure.
        """
        steps, self._steps = self._steps[::-1], []
        run_all(*steps)

    def _start(self) -> int:
        self._steps.append(self._end)  # also a session that failed to start must be ended
        try:
            return self.dcam.api_init()
        except DcamError as error:
            if error.code in (Error.BUSY, Error.EXCLUDED):
                self._steps.clear()  # ending it would end the session of another camera in this process
            if error.code != Error.NOCAMERA:
                raise
            raise DeviceError(
                self._device,
                "DCAM finds no camera",
                request=error.request,
                reply=codes.error_name(error.code),
                expected="a camera that is switched on and has started",
                advice=f"Switch the camera on and check its cable. {usb.preflight().message}",
                state="Nothing was changed",
            ) from error

    def _end(self) -> None:
        try:
            self.dcam.api_uninit()
        except DcamError:
            # Try once more: a session left open would block every later one in this process.
            self.dcam.api_uninit()
            raise


def run_all(*steps: Callable[[], None]) -> None:
    """Run every step, also after a failed one.

    Raises:
        DcamError: the first failure. An unplugged camera is not a failure: there is nothing to undo.
    """
    first: DcamError | None = None
    for step in steps:
        try:
            step()
        except DcamError as error:
            first = first or (None if error.code == Error.NOCONNECTION else error)
    if first is not None:
        raise first
