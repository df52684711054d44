"""Codecs: compressed pixels of areaDetector (NDPluginCodec), decoded by the filters of HDF5 that hdf5plugin brings.

A frame is written as the one chunk of a dataset in memory, undecoded, and read back. areaDetector leaves out the
headers with which filters of HDF5 begin their chunks: for bslz4 and lz4 they are put before the pixels (bitshuffle,
Masui et al. 2015; the LZ4 filter of the HDF Group).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

ELEMENTS = {1: "i1", 2: "i2", 3: "i4", 4: "i8", 5: "u1", 6: "u2", 7: "u4", 8: "u8", 9: "f4", 10: "f8"}
"""`codec.parameters` of NTNDArray: pvData's number of the pixels' type, for numpy."""
_BLOCK = 8192  # bytes of a block of bitshuffle


def _bare(payload: bytes, n_bytes: int, item: int) -> bytes:
    return payload


def _bslz4(payload: bytes, n_bytes: int, item: int) -> bytes:
    block = max(_BLOCK // item // 8 * 8, 128) * item  # bitshuffle's default: whole eights of elements
    return struct.pack(">QI", n_bytes, block) + payload


def _lz4(payload: bytes, n_bytes: int, item: int) -> bytes:
    return struct.pack(">QII", n_bytes, n_bytes, len(payload)) + payload


_CODECS: dict[str, tuple[Callable[[], Any], Callable[[bytes, int, int], bytes]]] = {
    "blosc": (hdf5plugin.Blosc, _bare),
    "bslz4": (hdf5plugin.Bitshuffle, _bslz4),
    "lz4": (hdf5plugin.LZ4, _lz4),
    "lz4hdf5": (hdf5plugin.LZ4, _bare),
}
NAMES = (*_CODECS,)


def decoded(codec: str, payload: NDArray[np.uint8], shape: tuple[int, int], dtype: np.dtype[Any]) -> NDArray[Any]:
    """The pixels [row, col] of a compressed frame, little-endian as nearly all IOCs are: the message does not say.

    Args:
        codec: one of NAMES.

    Raises:
        ValueError: they cannot be decoded.
    """
    make_filter, with_header = _CODECS[codec]
    n_bytes = dtype.itemsize * shape[0] * shape[1]
    chunk = payload.tobytes()
    if not chunk.startswith(struct.pack(">Q", n_bytes)):  # pvapy's simulator sends chunks of files as they are
        chunk = with_header(chunk, n_bytes, dtype.itemsize)
    try:
        with h5py.File("frame", "w", driver="core", backing_store=False) as file:
            held = file.create_dataset("frame", shape, dtype.newbyteorder("<"), chunks=shape, **make_filter())
            held.id.write_direct_chunk((0, 0), chunk)
            return held[()].astype(dtype, copy=False)
    except (OSError, RuntimeError) as error:
        raise ValueError(f"its {codec} pixels cannot be decoded ({error})") from error
