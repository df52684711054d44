"""Frames of areaDetector as values: an NTNDArray becomes pixels [row, col] with number, time, window and attributes.

Compressed pixels (NDPluginCodec) are decoded with the HDF5 filters that hdf5plugin brings. To decode a frame, its
compressed bytes are written as the only chunk of a dataset in memory, and the dataset is read. HDF5 filters begin their
chunks with a header that areaDetector leaves out: for bslz4 and lz4 it is put before the pixels (bitshuffle, Masui et
al. 2015; the LZ4 filter of the HDF Group).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

_MONO = 0
_COLOURS = {1: "Bayer", 2: "RGB1", 3: "RGB2", 4: "RGB3", 5: "YUV444", 6: "YUV422", 7: "YUV421"}
COUNTS = (np.dtype(np.uint8), np.dtype(np.uint16))


class FrameRefusedError(ValueError):
    """Frames of this kind cannot be stored as counts; the message says what to change."""


@dataclass(frozen=True)
class Window:
    """The part of the sensor that a frame shows, after all plugins through which the frame has passed.

    Attributes:
        shape: rows and columns of the frame.
        offset: (row, col) of its first pixel, in unbinned pixels of the sensor.
        binning: number of sensor pixels in a pixel, along rows and columns.
        reverse: whether rows and columns are mirrored.
    """

    shape: tuple[int, int]
    offset: tuple[int, int] = (0, 0)
    binning: tuple[int, int] = (1, 1)
    reverse: tuple[bool, bool] = (False, False)


@dataclass(frozen=True, eq=False)
class ArrayFrame:
    """One NTNDArray. Its pixels are decoded only by `counts`.

    Attributes:
        unique_id: the driver's number of the frame, usually from 1 at the start of an acquisition.
        time: s since the Unix epoch, when the driver received the frame, after readout.
        received: s since the Unix epoch, on this computer's clock.
        attributes: NDAttributes by name.
        is_current: True if the server already had this frame at the time of connecting. It is then an old frame, unless
            its number is new.
        codec: "" for raw pixels.
    """

    payload: NDArray[Any]
    dtype: np.dtype[Any]
    window: Window
    unique_id: int
    time: float
    received: float = math.nan
    codec: str = ""
    attributes: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    is_current: bool = False

    @property
    def kind(self) -> tuple[Window, np.dtype[Any]]:
        """Window and type, which do not change within a file."""
        return self.window, self.dtype

    @property
    def n_bytes(self) -> int:
        """Size of the pixels as received, in bytes."""
        return self.payload.nbytes

    def counts(self) -> NDArray[np.uint16]:
        """The pixels, uint16 [row, col]. ValueError: a compressed frame is damaged."""
        if not self.codec:
            return self.payload.reshape(self.window.shape).astype(np.uint16, copy=False)
        return decoded(self.codec, self.payload, self.window.shape, self.dtype).astype(np.uint16, copy=False)


def array_frame(value: Any, received: float, is_current: bool = False) -> ArrayFrame | None:
    """The frame in an NTNDArray that p4p has delivered with `nt=False`; None if it contains no pixels yet. The pixels
    are not copied.

    Raises:
        FrameRefusedError: colour, signed or real pixels, JPEG, or another codec or number of dimensions.
    """
    pixels = value.value
    if pixels is None or len(value.dimension) == 0:
        return None
    attributes = {each.name: each.value for each in value.attribute}
    codec, sizes = str(value.codec.name), [int(each.size) for each in value.dimension]
    _refuse_colour(attributes, sizes)
    if codec and codec not in NAMES:
        raise FrameRefusedError(
            f"the pixels are compressed with {codec}, which "
            + ("changes the counts" if codec == "jpeg" else "this program cannot decode")
            + (
                f"; set Codec1:Compressor to one of {', '.join(NAMES)}, or take the image from a plugin before the "
                "codec plugin"
            )
        )
    # The parameters of a codec have the type `any`: an int from servers of pvDatabase, None without a codec.
    element = ELEMENTS.get(int(value.codec.parameters or 0), "") if codec else pixels.dtype.str[1:]
    dtype = np.dtype(element) if element else np.dtype(np.float64)
    _refuse_type(dtype, codec, element)
    stamp = value.timeStamp
    window = _window(value.dimension)
    _refuse_size(window.shape, dtype, codec, pixels)
    return ArrayFrame(
        pixels,
        dtype,
        window,
        int(value.uniqueId),
        stamp.secondsPastEpoch + 1e-9 * stamp.nanoseconds,
        received,
        codec,
        attributes,
        is_current,
    )


def _refuse_colour(attributes: Mapping[str, Any], sizes: list[int]) -> None:
    mode = attributes.get("ColorMode", _MONO)
    if mode != _MONO or len(sizes) != 2:
        what = _COLOURS.get(mode, f"ColorMode {mode}") if mode != _MONO else f"in {len(sizes)} dimensions"
        raise FrameRefusedError(
            f"the pixels are {what}, but only single-colour images (Mono) can be stored; set cam1:ColorMode to "
            "Mono. If ColorMode is Mono, look for an earlier plugin that makes the array 3D"
        )


def _refuse_type(dtype: np.dtype[Any], codec: str, element: str) -> None:
    if codec and not element:
        raise FrameRefusedError(
            f"switch off compression (Codec1:Compressor None): frames with the codec {codec} do not state the type "
            "of their pixels"
        )
    if dtype not in COUNTS:
        raise FrameRefusedError(
            f"the pixels are {dtype}, but they must be uint8 or uint16; set cam1:DataType (or the DataType of the last "
            "plugin that changes pixels, such as Proc1) to UInt16"
        )


def _refuse_size(shape: tuple[int, int], dtype: np.dtype[Any], codec: str, pixels: NDArray[Any]) -> None:
    n_bytes = dtype.itemsize * math.prod(shape)
    if not 0 < n_bytes <= MOST_BYTES or not (codec or pixels.nbytes == n_bytes):
        raise FrameRefusedError(
            f"the size of the frame is wrong: {shape[0]} x {shape[1]} pixels of {dtype} must have as many bytes as "
            f"the array ({pixels.nbytes}), and at most {MOST_BYTES >> 20} MB"
        )


def _window(dimension: Any) -> Window:
    """The window; dimension[0] is x, which varies fastest."""
    x, y = dimension
    return Window(
        (int(y.size), int(x.size)),
        (int(y.offset), int(x.offset)),
        (int(y.binning) or 1, int(x.binning) or 1),
        (bool(y.reverse), bool(x.reverse)),
    )


ELEMENTS = {1: "i1", 2: "i2", 3: "i4", 4: "i8", 5: "u1", 6: "u2", 7: "u4", 8: "u8", 9: "f4", 10: "f8"}
"""The numpy type for each `codec.parameters` of NTNDArray, which is pvData's number for the type of the pixels."""
_BLOCK = 8192  # bytes of a block of bitshuffle
MOST_BYTES = 2**29  # largest frame: more than the largest sensors have
_MOST_RATIO = 256  # LZ4 expands one byte to at most 255


def _bslz4(payload: bytes, n_bytes: int, item: int) -> bytes:
    block = max(_BLOCK // item // 8 * 8, 128) * item  # default of bitshuffle: a multiple of eight elements
    return struct.pack(">QI", n_bytes, block) + payload


_CODECS: dict[str, tuple[Callable[[], Any], Callable[[bytes, int, int], bytes]]] = {
    "blosc": (hdf5plugin.Blosc, lambda payload, *sizes: payload),
    "bslz4": (hdf5plugin.Bitshuffle, _bslz4),
    "lz4": (hdf5plugin.LZ4, lambda payload, n, item: struct.pack(">QII", n, n, len(payload)) + payload),
    "lz4hdf5": (hdf5plugin.LZ4, lambda payload, *sizes: payload),
}
NAMES = (*_CODECS,)


def decoded(codec: str, payload: NDArray[np.uint8], shape: tuple[int, int], dtype: np.dtype[Any]) -> NDArray[Any]:
    """The pixels [row, col] of a compressed frame. The message does not state the byte order: little-endian is assumed,
    as in nearly all IOCs.

    Args:
        codec: one of NAMES.

    Raises:
        ValueError: the pixels cannot be decoded. A wrong size is found before memory is allocated.
    """
    make_filter, with_header = _CODECS[codec]
    n_bytes = dtype.itemsize * shape[0] * shape[1]
    held = int.from_bytes(payload[4:8].tobytes(), "little") if codec == "blosc" else _MOST_RATIO * payload.nbytes
    if held < n_bytes:
        raise ValueError(
            f"the {codec} pixels cannot be decoded, because the compressed data hold fewer than {shape[0]} x "
            f"{shape[1]} pixels"
        )
    chunk = payload.tobytes()
    if not chunk.startswith(struct.pack(">Q", n_bytes)):  # pvapy's simulator sends chunks with their header
        chunk = with_header(chunk, n_bytes, dtype.itemsize)
    try:
        with h5py.File("frame", "w", driver="core", backing_store=False) as file:
            frame = file.create_dataset("frame", shape, dtype.newbyteorder("<"), chunks=shape, **make_filter())
            frame.id.write_direct_chunk((0, 0), chunk)
            return frame[()].astype(dtype, copy=False)
    except (OSError, RuntimeError) as error:
        raise ValueError(f"the {codec} pixels cannot be decoded ({error})") from error
