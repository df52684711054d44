"""The DCAM-API v4 in numbers and ctypes: its error codes, strings, states, properties and values, and its structures.

On 64-bit machines natural alignment equals the vendor's 8-byte packing. Each structure begins with its size in bytes,
which the caller must set.
"""

from __future__ import annotations

import ctypes
from ctypes import c_char_p, c_double, c_int32, c_uint32, c_void_p
from enum import IntEnum, IntFlag
from types import MappingProxyType


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


class Error(IntEnum):
    """DCAMERR: a call failed if it returns a negative int32; these are the same 32 bits, unsigned.

    Codes of functions and options that this driver does not use are left out.
    """

    BUSY = 0x80000101
    ABORT = 0x80000102
    NOTREADY = 0x80000103
    NOTSTABLE = 0x80000104
    UNSTABLE = 0x80000105
    TIMEOUT = 0x80000106
    NOTBUSY = 0x80000107
    EXCLUDED = 0x80000110
    NORESOURCE = 0x80000201
    NOMEMORY = 0x80000203
    NOMODULE = 0x80000204
    NODRIVER = 0x80000205
    NOCAMERA = 0x80000206
    NOGRABBER = 0x80000207
    LOSTFRAME = 0x80000301
    COOLINGTROUBLE = 0x80000302
    NOTRIGGER = 0x80000303
    TEMPERATURE_TROUBLE = 0x80000304
    TOOFREQUENTTRIGGER = 0x80000305
    UNKNOWNSTRID = 0x80000802
    INVALIDCAMERA = 0x80000806
    INVALIDHANDLE = 0x80000807
    INVALIDPARAM = 0x80000808
    INVALIDVALUE = 0x80000821
    OUTOFRANGE = 0x80000822
    NOTWRITABLE = 0x80000823
    NOTREADABLE = 0x80000824
    INVALIDPROPERTYID = 0x80000825
    NEWAPIREQUIRED = 0x80000826
    INVALIDSUBARRAY = 0x8000082B
    ACCESSDENY = 0x8000082C
    WRONGPROPERTYVALUE = 0x8000082E
    NODEVICEBUFFER = 0x8000083B
    LESSSYSTEMMEMORY = 0x8000083F
    NOTIMPLEMENT = 0x80000F02
    NOTSUPPORT = 0x80000F03
    UNLOADED = 0x80000F04
    MISSINGFRAME_TROUBLE = 0x80000F06
    NOCONNECTION = 0x80000F07
    DELAYEDFRAME = 0x80000F09
    FAILOPEN = 0x80001001
    FRAMEGRABBER_NEEDS_FIRMWAREUPDATE = 0x80001002
    FAILOPENCAMERA = 0x82001001
    DEVICEPROBLEM = 0x82001002
    FAILREADCAMERA = 0x83001002
    FAILWRITECAMERA = 0x83001003
    OPTICS_UNPLUGGED = 0x83001005
    MISMATCH_CONFIGURATION = 0x83001011
    INVALIDWAITHANDLE = 0x84002001
    NEWRUNTIMEREQUIRED = 0x84002002
    VERSIONMISMATCH = 0x84002003
    DEVICEINITIALIZING = 0xB0000001


def error_name(code: int) -> str:
    """`TIMEOUT (0x80000106)` for a signed or unsigned code; only the number if the code is unknown."""
    unsigned = code & 0xFFFFFFFF
    try:
        return f"{Error(unsigned).name} (0x{unsigned:08X})"
    except ValueError:
        return f"error 0x{unsigned:08X}"


class CaptureState(IntEnum):
    """DCAMCAP_STATUS."""

    ERROR = 0
    BUSY = 1
    READY = 2
    STABLE = 3
    UNSTABLE = 4


class CaptureMode(IntEnum):
    """DCAMCAP_START: fill the ring repeatedly (SEQUENCE) or once (SNAP)."""

    SEQUENCE = -1
    SNAP = 0


class DcamEvent(IntFlag):
    """DCAMWAIT_CAPEVENT."""

    FRAMEREADY = 0x0002
    STOPPED = 0x0010


class Capability(IntFlag):
    """DCAMDEV_CAPFLAG, domain of functions: the stamps that frames carry."""

    FRAMESTAMP = 0x0001
    TIMESTAMP = 0x0002
    CAMERASTAMP = 0x0004


class Cooler(IntEnum):
    """SENSORCOOLERSTATUS; negative values are faults. An unknown positive number counts as NONE."""

    ERROR4 = -4
    ERROR3 = -3
    ERROR2 = -2
    ERROR1 = -1
    NONE = 0
    OFF = 1
    READY = 2
    BUSY = 3
    ALWAYS = 4
    WARNING = 5

    @classmethod
    def _missing_(cls, value: object) -> Cooler:
        return cls.ERROR1 if isinstance(value, int) and value < 0 else cls.NONE


class Text(IntEnum):
    """DCAM_IDSTR: the strings of dcamdev_getstring."""

    BUS = 0x04000101
    CAMERAID = 0x04000102
    VENDOR = 0x04000103
    MODEL = 0x04000104
    CAMERAVERSION = 0x04000105
    DRIVERVERSION = 0x04000106
    MODULEVERSION = 0x04000107
    DCAMAPIVERSION = 0x04000108


class Property(IntEnum):
    """DCAM_IDPROP. All values are passed as double."""

    TRIGGERSOURCE = 0x00100110
    TRIGGERACTIVE = 0x00100120
    TRIGGER_MODE = 0x00100210
    TRIGGERPOLARITY = 0x00100220
    TRIGGERTIMES = 0x00100240
    TRIGGERDELAY = 0x00100260
    TRIGGER_GLOBALEXPOSURE = 0x001F0300
    EXPOSURETIME = 0x001F0110
    SENSORTEMPERATURE = 0x00200310
    SENSORTEMPERATURETARGET = 0x00200330
    SENSORCOOLERSTATUS = 0x00200340
    READOUTSPEED = 0x00400110
    SENSORMODE = 0x00400210
    BINNING = 0x00401110
    SUBARRAYHPOS = 0x00402110
    SUBARRAYHSIZE = 0x00402120
    SUBARRAYVPOS = 0x00402130
    SUBARRAYVSIZE = 0x00402140
    SUBARRAYMODE = 0x00402150
    TIMING_READOUTTIME = 0x00403010
    TIMING_CYCLICTRIGGERPERIOD = 0x00403020
    TIMING_MINTRIGGERBLANKING = 0x00403030
    TIMING_MINTRIGGERINTERVAL = 0x00403050
    INTERNAL_FRAMEINTERVAL = 0x00403820
    BITSPERCHANNEL = 0x00420130
    IMAGE_WIDTH = 0x00420210
    IMAGE_HEIGHT = 0x00420220
    IMAGE_PIXELTYPE = 0x00420270
    BUFFER_FRAMEBYTES = 0x00420340
    FRAMEBUNDLE_MODE = 0x00421010
    TIMESTAMP_PRODUCER = 0x00410A10
    FRAMESTAMP_PRODUCER = 0x00410A20
    DEFECTCORRECT_MODE = 0x00470010
    HOTPIXELCORRECT_LEVEL = 0x00470030
    CONVERSIONFACTOR_COEFF = 0x00FFE010
    CONVERSIONFACTOR_OFFSET = 0x00FFE020


QUERY_NEXT = 0x01000000  # one of the options of dcamprop_queryvalue
ATTRIBUTE_TYPE_MASK, ATTRIBUTE_TYPE_MODE = 0x0F, 1
UNIT_SECOND = 1
ATTRIBUTE_HASRANGE = 0x80000000  # a bit of DCAMPROP_ATTR.attribute

# Values of mode properties.
OFF, ON = 1, 2
SENSORMODE_AREA, SENSORMODE_PHOTONNUMBERRESOLVING = 1, 18
READOUTSPEED_ULTRA_QUIET, READOUTSPEED_STANDARD = 1, 2  # on the ORCA-Quest
PIXELTYPE_MONO16 = 2
PRODUCERS = MappingProxyType({1: "nobody", 2: "the library", 3: "the driver", 4: "the interface", 5: "the camera"})
"""Who produces time- and framestamps, by the value of the producer properties."""
