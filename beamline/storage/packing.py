"""Packed numbers: datasets whose attributes (scale, offset) say how stored numbers are converted to values, as in CF
(netCDF) and CIL files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.text import printable

_CF, _CIL = ("scale_factor", "add_offset"), ("scale", "offset")
_NAMES = {*_CF, *_CIL, "_FillValue", "missing_value", "valid_range", "valid_min", "valid_max", "_Unsigned"}


class PackedDataset(h5py.Dataset):  # type: ignore[misc]  # h5py has no types
    """A dataset whose numbers are unpacked on reading; `id.dtype` is the stored type."""

    def __init__(self, item: h5py.Dataset, values: Callable[[Any], NDArray[Any]]) -> None:
        super().__init__(item.id)
        self._stored, self._values = item, values

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.result_type(self._stored.dtype, np.float32)

    def __getitem__(self, args: Any, new_dtype: Any = None) -> NDArray[Any]:
        return self._values(self._stored.__getitem__(args, new_dtype))


def unpacked(item: h5py.Dataset) -> h5py.Dataset:
    """The dataset. If its numbers are packed, they are unpacked when they are read. Raises DataError as `packing`
    does.
    """
    if not isinstance(item, h5py.Dataset) or item.dtype.kind not in "uif" or not _NAMES & {*item.attrs}:
        return item  # an array of a Zarr already unpacks its numbers
    by_cil = "cil_version" in item.file.attrs or "NEXUSDataWriter" in str(item.file.attrs.get("creator"))
    values = packing(item.attrs, item.dtype, f"{item.name} in {item.file.filename}", by_cil=by_cil)
    return item if values is None else PackedDataset(item, values)


def packing(
    attributes: Mapping[str, Any], dtype: np.dtype[Any], where: str, *, by_cil: bool
) -> Callable[[Any], NDArray[Any]] | None:
    """A function that converts stored numbers [...] to values. Numbers that mark missing values become NaN. None if the
    stored numbers are the values.

    The values have a real type that can represent all stored numbers. They are stored * scale_factor + add_offset in CF
    files, and (stored - offset) / scale in CIL files.

    Args:
        attributes: attributes of the dataset.
        dtype: type of the stored numbers.
        where: name of the dataset in an error message.
        by_cil: True if CIL wrote the file. Other programs use the names `scale` and `offset` with another meaning.

    Raises:
        DataError: the meaning of the attributes is unknown, or they do not give finite values.
    """
    real = np.result_type(dtype, np.float32)
    pair = _CIL if dtype.kind in "ui" and {*_CIL} <= {*attributes} and not {*_CF} & {*attributes} else _CF
    pair_values = [np.ravel(attributes.get(name, plain)) for name, plain in zip(pair, (1, 0), strict=True)]
    scale, offset = (float(each[0]) if each.size == 1 and each.dtype.kind in "uif" else np.nan for each in pair_values)
    if not (scale and np.isfinite(scale + offset)) or (pair is _CIL and not by_cil and (scale, offset) != (1, 0)):
        shown = " and ".join(
            f"{name} {printable(str(each))[1:40].strip(']')}" for name, each in zip(pair, pair_values, strict=True)
        )
        raise DataError(
            f"{where} has the attributes {shown}, but it is unknown how these attributes convert the stored numbers. "
            "In a copy of the file, name the attributes scale_factor and add_offset (value = stored * scale_factor "
            "+ add_offset), or store the converted values."
        )
    if pair is _CIL:
        scale, offset = 1 / scale, -offset / scale
    unsigned = dtype.kind == "i" and "true" in str(attributes.get("_Unsigned")).lower()
    signed = np.dtype(dtype.str.replace("i", "u")) if unsigned else dtype
    fills = np.concatenate([np.ravel(attributes.get(name, [])) for name in ("_FillValue", "missing_value")])
    ends = (-np.inf, np.inf) if dtype.kind == "f" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    # a NaN is already a missing value
    fills = fills[(fills >= ends[0]) & (fills <= ends[1])].astype(dtype).view(signed)
    limits = np.ravel(
        attributes.get("valid_range", [attributes.get("valid_min", -np.inf), attributes.get("valid_max", np.inf)])
    )
    # these numbers are in the unit of the values, because their type differs from the stored type
    if limits.dtype.kind == "f" and dtype.kind != "f":
        limits = np.rint((limits - offset) / scale)
    low, high = limits.min(), limits.max()
    if (scale, offset, signed, fills.size) == (1, 0, dtype, 0) and low <= ends[0] and ends[1] <= high:
        return None

    def values(stored: Any) -> NDArray[Any]:
        numbers = np.asarray(stored, dtype).view(signed)  # a single number has the byte order of this machine
        real_values = np.asarray(numbers.astype(real) * scale + offset, real)
        real_values[np.isin(numbers, fills) | (numbers < low) | (numbers > high)] = np.nan
        return real_values

    return values
