"""Codecs: the lossless compressors of archived scans, by name; without HDF5, so that a command's help loads quickly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

CODECS = ("blosc2", "bitshuffle-zstd", "bitshuffle-lz4")  # The first is the default


def filter_of(codec: str) -> Mapping[str, Any]:
    """The keywords of an HDF5 dataset that is compressed by a codec of these."""
    import hdf5plugin

    filters: Mapping[str, Any] = {
        "blosc2": hdf5plugin.Blosc2("zstd", clevel=1, filters=hdf5plugin.Blosc2.BITSHUFFLE),
        "bitshuffle-zstd": hdf5plugin.Bitshuffle(cname="zstd", clevel=3),
        "bitshuffle-lz4": hdf5plugin.Bitshuffle(cname="lz4"),
    }[codec]
    return filters
