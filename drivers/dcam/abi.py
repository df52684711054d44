"""DCAM-API v4 through ctypes: loads the library, with one Python method for each function that this driver calls."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from ctypes import POINTER, byref, c_char_p, c_double, c_int32, c_void_p, sizeof
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

from drivers.base.causes import of_library
from drivers.base.errors import DeviceError
from drivers.dcam.codes import (
    ApiInit,
    BufFrame,
    Capability,
    CaptureMode,
    CaptureState,
    DevCapability,
    DevOpen,
    DevString,
    Error,
    PropAttr,
    Property,
    Text,
    TransferInfo,
    WaitOpen,
    WaitStart,
    error_name,
)

_TEXT_BYTES = 256
_USUAL_ADVICE = "Check the camera's power and cable, switch it off and on, and try again"
RUNTIME = "Check the version of the vendor's DCAM-API runtime"


ARGUMENTS: Mapping[str, tuple[Any, ...]] = MappingProxyType(
    {
        "dcamapi_init": (POINTER(ApiInit),),
        "dcamapi_uninit": (),
        "dcamdev_open": (POINTER(DevOpen),),
        "dcamdev_close": (c_void_p,),
        "dcamdev_getcapability": (c_void_p, POINTER(DevCapability)),
        "dcamdev_getstring": (c_void_p, POINTER(DevString)),
        "dcamprop_getattr": (c_void_p, POINTER(PropAttr)),
        "dcamprop_getvalue": (c_void_p, c_int32, POINTER(c_double)),
        "dcamprop_setvalue": (c_void_p, c_int32, c_double),
        "dcamprop_queryvalue": (c_void_p, c_int32, POINTER(c_double), c_int32),
        "dcambuf_alloc": (c_void_p, c_int32),
        "dcambuf_release": (c_void_p, c_int32),
        "dcambuf_lockframe": (c_void_p, POINTER(BufFrame)),
        "dcamcap_start": (c_void_p, c_int32),
        "dcamcap_stop": (c_void_p,),
        "dcamcap_status": (c_void_p, POINTER(c_int32)),
        "dcamcap_transferinfo": (c_void_p, POINTER(TransferInfo)),
        "dcamcap_firetrigger": (c_void_p, c_int32),
        "dcamwait_open": (POINTER(WaitOpen),),
        "dcamwait_close": (c_void_p,),
        "dcamwait_abort": (c_void_p,),
        "dcamwait_start": (c_void_p, POINTER(WaitStart)),
    }
)
"""Every function that this driver calls, with its argument types; all return an int32."""

_ADVICE: Mapping[int, str] = MappingProxyType(
    {
        Error.NOCAMERA: "Switch the camera on and check its cable",
        Error.NODRIVER: "Install the vendor's DCAM-API runtime and its driver",
        Error.NOMODULE: "Install the DCAM-API module for this camera's interface (USB3 or CoaXPress)",
        Error.NOGRABBER: "Check the frame grabber and its driver",
        Error.FAILOPENCAMERA: "Close other programs that use the camera, then switch it off and on",
        Error.NOCONNECTION: "Check the camera's power and cable, then connect again",
        Error.NOMEMORY: "Give the camera's ring buffer fewer bytes, or free memory",
        Error.BUSY: "End the running capture, or other sessions with the camera in this process",
        Error.FAILOPEN: "Close other programs that use the camera, then switch it off and on",
        Error.TOOFREQUENTTRIGGER: "Turn the stage more slowly or use a shorter exposure: triggers arrive too fast",
        Error.NOTRIGGER: "Check the trigger cable and its polarity",
        Error.DEVICEINITIALIZING: "The camera is still starting: wait half a minute and try again",
        Error.FRAMEGRABBER_NEEDS_FIRMWAREUPDATE: "Update the frame grabber's firmware with the vendor's tool",
        Error.NEWRUNTIMEREQUIRED: "Install a newer DCAM-API runtime",
        Error.NEWAPIREQUIRED: "Install a newer DCAM-API runtime",
        Error.COOLINGTROUBLE: "Check the camera's fan and cooling water, and let it cool down",
        Error.TEMPERATURE_TROUBLE: "Check the camera's fan and cooling water, and let it cool down",
        Error.LESSSYSTEMMEMORY: "Give the camera's ring buffer fewer bytes, or free memory",
    }
)


_STATE: Mapping[str, str] = MappingProxyType(
    {
        "dcamprop_setvalue": "The setting was not changed",
        "dcambuf_alloc": "The camera is not armed and no frame was taken",
        "dcamcap_start": "The camera is not armed and no frame was taken",
        "dcamcap_stop": "The camera may still capture; frames taken before are good",
        "dcambuf_release": "The camera's ring buffer is still allocated; frames taken before are good",
        "dcamwait_close": "The camera may remain reserved until this program ends",
        "dcamdev_close": "The camera may remain reserved until this program ends",
        "dcamapi_uninit": "The camera may remain reserved until this program ends",
        "dcamapi_init": "No camera was opened",
        "dcamdev_open": "No camera was opened",
        "dcamcap_firetrigger": "No frame was exposed",
    }
)
"""For each call, a sentence on the state after the call has failed. Calls that are not in this list only read
values."""


class DcamError(DeviceError):
    """A DCAM call returned an error; `code` is one of `codes.Error`, or an unknown number."""

    def __init__(self, device: str, call: str, code: int) -> None:
        self.code = code & 0xFFFFFFFF
        super().__init__(
            device,
            "the camera's library reports an error",
            request=call,
            reply=error_name(code),
            expected="a return value of 0 or more (success)",
            advice=_ADVICE.get(self.code, _USUAL_ADVICE),
            state=_STATE.get(call.split()[0], "Nothing was changed; frames taken before are good"),
        )


def installed_library(platform: str) -> str:
    """File name of the library that the vendor's runtime installs; `platform` is a value of sys.platform."""
    return "dcamapi.dll" if platform == "win32" else "libdcamapi.so"


STARTS_WITHIN = 20.0  # s; time for the library to look for cameras, which usually takes some seconds
_SURVIVED = 86  # exit code of a test process whose library has started, or has reported an error
_TRIAL = f"""
import ctypes, os, sys
try:
    library = ctypes.CDLL(sys.argv[1], mode=ctypes.RTLD_GLOBAL, winmode=0)
    library.dcamapi_init(ctypes.create_string_buffer(bytes.fromhex(sys.argv[2])))
    library.dcamapi_uninit()
except (OSError, AttributeError):
    pass
os._exit({_SURVIVED})
"""


@cache
def try_out(name: str, device: str) -> None:
    """Test a library before use: load and start it in a separate process, in which it may hang or crash. The test is
    made once per process.

    A program with a built-in Python cannot start another Python, and skips this test.

    Raises:
        DeviceError: the library does not return, or ends the separate process.
    """
    if "python" not in Path(sys.executable or "").name.lower():
        return
    process = subprocess.Popen(
        [sys.executable, "-P", "-S", "-c", _TRIAL, name, bytes(ApiInit(size=sizeof(ApiInit))).hex()],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,  # so that Ctrl-C reaches only this process
        creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
    )
    try:
        *_, last = process.communicate(timeout=STARTS_WITHIN)[1].decode(errors="replace").splitlines() or [""]
        if process.returncode == _SURVIVED:
            return
        how = f"ends every process that loads it (code {process.returncode}{last and ', '}{last})"
    except subprocess.TimeoutExpired:
        how = f"did not finish starting within {STARTS_WITHIN:g} s"
        process.kill()
        with suppress(subprocess.TimeoutExpired):  # a process that hangs in the driver cannot be killed
            process.communicate(timeout=1)
    raise DeviceError(
        device,
        f"the camera's library {name} {how}",
        advice="End other programs that use the camera, and switch it off and on. If the error persists, "
        "reinstall the vendor's DCAM-API runtime, with only the modules and drivers of this camera's "
        "interface",
        state="The library was tested in a separate process, and nothing was changed",
    )


class Dcam:
    """A loaded DCAM library. Handles are plain integers. Every method raises DcamError if the library returns an error.

    Calls that wait release Python's global interpreter lock.

    Args:
        library: path of the library; None: the installed one.
        device: name of the camera in error messages.

    Raises:
        DeviceError: the library cannot be loaded, or a function is missing in it.
    """

    def __init__(self, library: Path | None, device: str) -> None:
        self._device = device
        # A name without a folder is searched for only in the folders of the system; a path is used as it is.
        name = str(library.resolve() if library and library.exists() else library or installed_library(sys.platform))
        try_out(name, device)
        try:
            # RTLD_GLOBAL: the camera modules that the library loads resolve their symbols from it.
            # winmode 0: the full Windows search path, where the vendor's runtime installs itself.
            loaded = ctypes.CDLL(name, mode=ctypes.RTLD_GLOBAL, winmode=0)
        except OSError as error:
            cause, todo = of_library(name, error)
            problem = f"the camera's library {name} cannot be loaded{cause and ': '}{cause} ({error})"
            advice = todo or "Install the vendor's DCAM-API runtime, or give the library's path in the configuration"
            raise DeviceError(device, problem, advice=advice, state="Nothing was changed") from error
        missing = [call for call in ARGUMENTS if getattr(loaded, call, None) is None]
        if missing:
            problem = f"{name} is not a DCAM-API version 4 library, because it has no {', '.join(missing)}"
            raise DeviceError(
                device, problem, advice="Check the library's path and version", state="Nothing was changed"
            )
        self._functions = {call: getattr(loaded, call) for call in ARGUMENTS}
        for call, function in self._functions.items():
            function.argtypes, function.restype = ARGUMENTS[call], c_int32

    def _call(self, call: str, *arguments: Any, detail: str = "") -> None:
        code = self._functions[call](*arguments)
        if code < 0:
            raise DcamError(self._device, f"{call} {detail}".rstrip(), code)

    def api_init(self) -> int:
        """Start the session (this takes seconds with a real camera); returns the number of cameras found."""
        init = ApiInit(size=sizeof(ApiInit))
        self._call("dcamapi_init", byref(init))
        return int(init.device_count)

    def api_uninit(self) -> None:
        """End the session; this closes everything that is open."""
        self._call("dcamapi_uninit")

    def dev_open(self, index: int) -> int:
        """Open camera `index`; returns its handle."""
        opened = DevOpen(size=sizeof(DevOpen), index=index)
        self._call("dcamdev_open", byref(opened), detail=f"index {index}")
        return int(opened.camera)

    def dev_close(self, camera: int) -> None:
        self._call("dcamdev_close", camera)

    def dev_getcapability(self, camera: int) -> Capability:
        """The stamps (count, time) of frames, according to the library."""
        capability = DevCapability(size=sizeof(DevCapability))  # domain 0: functions
        self._call("dcamdev_getcapability", camera, byref(capability))
        return Capability(capability.flags)

    def dev_getstring(self, camera: int, which: Text) -> str:
        buffer = ctypes.create_string_buffer(_TEXT_BYTES)
        string = DevString(sizeof(DevString), which, ctypes.cast(buffer, c_char_p), _TEXT_BYTES)
        self._call("dcamdev_getstring", camera, byref(string), detail=which.name)
        return buffer.value.decode("ascii", errors="replace")

    def prop_getattr(self, camera: int, prop: Property) -> PropAttr:
        """Range, step and access of a property in the camera's current state."""
        attribute = PropAttr(size=sizeof(PropAttr), prop=prop)
        self._call("dcamprop_getattr", camera, byref(attribute), detail=prop.name)
        return attribute

    def prop_getvalue(self, camera: int, prop: Property) -> float:
        value = c_double()
        self._call("dcamprop_getvalue", camera, prop, byref(value), detail=prop.name)
        return value.value

    def prop_setvalue(self, camera: int, prop: Property, value: float) -> None:
        self._call("dcamprop_setvalue", camera, prop, value, detail=f"{prop.name} = {value:g}")

    def prop_queryvalue(self, camera: int, prop: Property, value: float, option: int) -> float:
        """The allowed value next to `value` in the direction `option`. Raises an error if there is none."""
        answer = c_double(value)
        self._call("dcamprop_queryvalue", camera, prop, byref(answer), option, detail=prop.name)
        return answer.value

    def buf_alloc(self, camera: int, frames: int) -> None:
        """Allocate a ring buffer in the library's memory.

        Until it is released, properties that change the frame size are locked.
        """
        self._call("dcambuf_alloc", camera, frames, detail=f"{frames} frames")

    def buf_release(self, camera: int) -> None:
        self._call("dcambuf_release", camera, 0)

    def buf_lockframe(self, camera: int, slot: int) -> BufFrame:
        """Address and stamps of the frame in a slot. They are valid until the ring overwrites the frame, because DCAM
        has no call to unlock it."""
        frame = BufFrame(size=sizeof(BufFrame), index=slot)
        self._call("dcambuf_lockframe", camera, byref(frame), detail=f"slot {slot}")
        return frame

    def cap_start(self, camera: int, mode: CaptureMode) -> None:
        self._call("dcamcap_start", camera, mode, detail=mode.name)

    def cap_stop(self, camera: int) -> None:
        """Stop the capture; allowed in every state."""
        self._call("dcamcap_stop", camera)

    def cap_status(self, camera: int) -> CaptureState:
        status = c_int32()
        self._call("dcamcap_status", camera, byref(status))
        try:
            return CaptureState(status.value)
        except ValueError:
            problem = f"the capture status of the camera is {status.value}, which DCAM-API version 4 does not define"
            raise DeviceError(
                self._device,
                problem,
                request="dcamcap_status",
                reply=str(status.value),
                expected=", ".join(state.name for state in CaptureState),
                advice=RUNTIME,
                state="Frames taken before are good",
            ) from None

    def cap_transferinfo(self, camera: int) -> int:
        """Number of frames written to the ring since the start; never blocks."""
        info = TransferInfo(size=sizeof(TransferInfo))
        self._call("dcamcap_transferinfo", camera, byref(info))
        return int(info.count)

    def cap_firetrigger(self, camera: int) -> None:
        self._call("dcamcap_firetrigger", camera, 0)

    def wait_open(self, camera: int) -> tuple[int, int]:
        """Open a wait handle; returns it and the events that this camera can signal."""
        opened = WaitOpen(size=sizeof(WaitOpen), camera=camera)
        self._call("dcamwait_open", byref(opened))
        return int(opened.wait), int(opened.supported)

    def wait_close(self, wait: int) -> None:
        self._call("dcamwait_close", wait)

    def wait_abort(self, wait: int) -> None:
        """End the wait of another thread. Does nothing if no thread waits."""
        self._call("dcamwait_abort", wait)

    def wait_start(self, wait: int, mask: int, timeout_ms: int) -> None:
        """Wait for an event in `mask`. Several events may arrive as one, so use the transfer count to find how many
        frames arrived.

        Raises: DcamError: the call failed; the codes TIMEOUT, ABORT, LOSTFRAME and MISSINGFRAME_TROUBLE are possible,
        too.
        """
        start = WaitStart(size=sizeof(WaitStart), mask=mask, timeout_ms=timeout_ms)
        self._call("dcamwait_start", wait, byref(start), detail=f"for {timeout_ms} ms")
