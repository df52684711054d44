"""Structures of the DCAM-API v4 in ctypes.

On 64-bit machines natural alignment equals the vendor's 8-byte packing. Each structure begins with its size in bytes,
which the caller must set.
"""

from __future__ import annotations

import ctypes
from ctypes import c_char_p, c_double, c_int32, c_uint32, c_void_p


class ApiInit(ctypes.Structure):
    """DCAMAPI_INIT."""

    _fields_ = (
        ("size", c_int32),
        ("device_count", c_int32),
        ("reserved", c_int32),
        ("option_bytes", c_int32),
        ("options", c_void_p),
        ("guid", c_void_p),
    )


class DevOpen(ctypes.Structure):
    """DCAMDEV_OPEN."""

    _fields_ = (("size", c_int32), ("index", c_int32), ("camera", c_void_p))


class DevCapability(ctypes.Structure):
    """DCAMDEV_CAPABILITY."""

    _fields_ = (("size", c_int32), ("domain", c_int32), ("flags", c_int32), ("kind", c_int32))


class DevString(ctypes.Structure):
    """DCAMDEV_STRING."""

    _fields_ = (("size", c_int32), ("which", c_int32), ("text", c_char_p), ("text_bytes", c_int32))


class PropAttr(ctypes.Structure):
    """DCAMPROP_ATTR."""

    _fields_ = (
        ("size", c_int32),
        ("prop", c_int32),
        ("option", c_int32),
        ("reserved1", c_int32),
        ("attribute", c_int32),
        ("group", c_int32),
        ("unit", c_int32),
        ("attribute2", c_int32),
        ("minimum", c_double),
        ("maximum", c_double),
        ("step", c_double),
        ("default", c_double),
        ("max_channel", c_int32),
        ("reserved3", c_int32),
        ("max_view", c_int32),
        ("number_of_element", c_int32),
        ("array_base", c_int32),
        ("element_step", c_int32),
    )


class TimeStamp(ctypes.Structure):
    """DCAM_TIMESTAMP, from an epoch of the camera's own: only differences have a meaning."""

    _fields_ = (("seconds", c_uint32), ("microseconds", c_int32))


class TransferInfo(ctypes.Structure):
    """DCAMCAP_TRANSFERINFO."""

    _fields_ = (("size", c_int32), ("kind", c_int32), ("newest", c_int32), ("count", c_int32))


class BufFrame(ctypes.Structure):
    """DCAMBUF_FRAME."""

    _fields_ = (
        ("size", c_int32),
        ("kind", c_int32),
        ("option", c_int32),
        ("index", c_int32),
        ("buffer", c_void_p),
        ("row_bytes", c_int32),
        ("pixel_type", c_int32),
        ("width", c_int32),
        ("height", c_int32),
        ("left", c_int32),
        ("top", c_int32),
        ("timestamp", TimeStamp),
        ("framestamp", c_int32),
        ("camerastamp", c_int32),
    )


class WaitOpen(ctypes.Structure):
    """DCAMWAIT_OPEN."""

    _fields_ = (("size", c_int32), ("supported", c_int32), ("wait", c_void_p), ("camera", c_void_p))


class WaitStart(ctypes.Structure):
    """DCAMWAIT_START."""

    _fields_ = (("size", c_int32), ("happened", c_int32), ("mask", c_int32), ("timeout_ms", c_int32))
