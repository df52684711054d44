"""Session: the library started, one camera and its wait handle opened, and all of it let go again in order."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from drivers import usb
from drivers.dcam import codes
from drivers.dcam.abi import Dcam, DcamError
from drivers.dcam.codes import Error, Event
from drivers.errors import DeviceError


class Session:
    """What a camera needs of the library. A process can have one at a time.

    Args:
        library: path of the DCAM-API library; None takes the installed one.
        index: which camera, where DCAM finds several.
        device: what errors call it.

    Raises:
        DeviceError: no library, or no camera; nothing stays open.
    """

    def __init__(self, library: Path | None, index: int, device: str) -> None:
        self.dcam = Dcam(library, device)
        self._device = device
        self._steps: list[Callable[[], None]] = []  # to undo, last first
        try:
            found = self._start()
            if index >= found:
                raise DeviceError(
                    device,
                    f"there is no camera {index}",
                    expected=f"an index below {found}, as DCAM found",
                    advice="Correct the camera's index in the configuration",
                    state="Nothing was changed",
                )
            self.camera = self.dcam.dev_open(index)
            self._steps.append(lambda: self.dcam.dev_close(self.camera))  # ends a capture and frees the ring, too
            self.wait, supported = self.dcam.wait_open(self.camera)
            self._steps.append(lambda: self.dcam.wait_close(self.wait))
            self.events = (Event.FRAMEREADY | Event.STOPPED) & supported
        except BaseException:
            with suppress(DcamError):
                self.close()
            raise

    def close(self) -> None:
        """Let go of everything, also where a step fails; may be called again.

        Raises:
            DcamError: the first failure. That a camera is not connected any more is none.
        """
        steps, self._steps = self._steps[::-1], []
        run_all(*steps)

    def _start(self) -> int:
        self._steps.append(self._end)  # a session that failed to start must be ended too
        try:
            return self.dcam.api_init()
        except DcamError as error:
            if error.code in (Error.BUSY, Error.EXCLUDED):
                self._steps.clear()  # to end it would end that of another camera in this process
            if error.code != Error.NOCAMERA:
                raise
            raise DeviceError(
                self._device,
                "DCAM finds no camera",
                request=error.request,
                reply=codes.error_name(error.code),
                expected="a camera that is switched on and started",
                advice=f"Switch the camera on and check its cable. {usb.preflight().message}",
                state="Nothing was changed",
            ) from error

    def _end(self) -> None:
        try:
            self.dcam.api_uninit()
        except DcamError:
            # A session that stays would keep this process from ever having another one.
            self.dcam.api_uninit()
            raise


def run_all(*steps: Callable[[], None]) -> None:
    """Run every step, also after one that failed.

    Raises:
        DcamError: the first failure. That a camera is not connected any more is none: there is nothing left to undo.
    """
    first: DcamError | None = None
    for step in steps:
        try:
            step()
        except DcamError as error:
            first = first or (None if error.code == Error.NOCONNECTION else error)
    if first is not None:
        raise first
