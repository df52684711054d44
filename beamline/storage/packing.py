"""Packed numbers: of a dataset whose attributes say how they are read, as CF (netCDF) and CIL write them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.text import printable

_CF, _CIL = ("scale_factor", "add_offset"), ("scale", "offset")
_FILLS = ("_FillValue", "missing_value")
_SHOWN = 40  # letters of what is no number
_NAMES = {"_Unsigned", "valid_range", "valid_min", "valid_max", *_CF, *_CIL, *_FILLS}


@dataclass(frozen=True, eq=False)
class Packing:
    """What stored numbers mean: stored * scale + offset; NaN where they stand for no value.

    Attributes:
        stored: their type, with the sign that is meant.
        scale, offset: of the values.
        fills: stored numbers that are no values.
        limits: the lowest and the highest stored number that is a value.
    """

    stored: np.dtype[Any]
    scale: float
    offset: float
    fills: NDArray[Any]
    limits: tuple[float, float]

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the values, real numbers that hold all stored ones."""
        return np.result_type(self.stored, np.float32)

    def values(self, stored: Any) -> NDArray[Any]:
        """The values of stored numbers [...]."""
        stored = np.asarray(stored).view(self.stored)
        values = np.asarray(stored.astype(self.dtype) * self.scale + self.offset, self.dtype)
        low, high = self.limits
        values[np.isin(stored, self.fills) | (stored < low) | (stored > high)] = np.nan
        return values


class PackedDataset(h5py.Dataset):  # type: ignore[misc]  # h5py has no types
    """A dataset that is read as the values of its numbers; `id.dtype` is the type that is stored."""

    def __init__(self, item: h5py.Dataset, packing: Packing) -> None:
        super().__init__(item.id)
        self._stored, self._packing = item, packing

    @property
    def dtype(self) -> np.dtype[Any]:
        return self._packing.dtype

    def __getitem__(self, args: Any, new_dtype: Any = None) -> NDArray[Any]:
        return self._packing.values(self._stored.__getitem__(args, new_dtype))


def unpacked(item: h5py.Dataset) -> h5py.Dataset:
    """A dataset that is read as the values of its numbers. DataError as of `packing_of`."""
    if item.dtype.kind not in "uif" or not _NAMES & {*item.attrs}:
        return item
    by_cil = "cil_version" in item.file.attrs or b"NEXUSDataWriter" in np.ravel(item.file.attrs.get("creator", ""))
    packing = packing_of(item.attrs, item.dtype, f"{item.name} in {item.file.filename}", by_cil=by_cil)
    return item if packing is None else PackedDataset(item, packing)


def packing_of(said: Mapping[str, Any], dtype: np.dtype[Any], where: str, *, by_cil: bool) -> Packing | None:
    """How numbers of a type are packed by what is said of them; None where they are the values.

    By CF value = stored * scale_factor + add_offset, by CIL value = (stored - offset) / scale.

    Args:
        by_cil: CIL wrote them: others mean something else by scale and offset.

    Raises:
        DataError: what is said is no such number, or may be meant in two ways.
    """
    pair = _CIL if dtype.kind in "ui" and {*_CIL} <= {*said} and not {*_CF} & {*said} else _CF
    scale, offset = (_number(said, name, plain, where) for name, plain in zip(pair, (1.0, 0.0), strict=True))
    if scale == 0 or (pair is _CIL and not by_cil and (scale, offset) != (1, 0)):
        raise DataError(
            f"{where} has the attributes {pair[0]} {scale:g} and {pair[1]} {offset:g}, and nothing says how its numbers "
            "are read by them. In a copy, name them scale_factor and add_offset, where value = stored * scale_factor + "
            "add_offset, or store the values."
        )
    if pair is _CIL:
        scale, offset = 1 / scale, -offset / scale
    unsigned = dtype.kind == "i" and "true" in str(said.get("_Unsigned", "")).lower()
    stored = np.dtype(dtype.str.replace("i", "u")) if unsigned else dtype
    fills = [np.ravel(said[name]) for name in _FILLS if name in said]
    known = np.concatenate([fill.astype(dtype) for fill in fills if fill.dtype.kind in "uif"] or [np.empty(0, dtype)])
    known = known[known == known].view(stored)  # without NaN, which are no values as they are
    limits = np.ravel(said.get("valid_range", [said.get("valid_min", -np.inf), said.get("valid_max", np.inf)]))
    if limits.dtype.kind == "f" and dtype.kind != "f":  # in the unit of the values, as these have another type
        limits = np.rint((limits - offset) / scale)
    low, high = np.sort(limits.astype(np.float64))
    ends = (-np.inf, np.inf) if stored.kind == "f" else (np.iinfo(stored).min, np.iinfo(stored).max)
    if (scale, offset, stored, known.size) == (1, 0, dtype, 0) and low <= ends[0] and ends[1] <= high:
        return None
    return Packing(stored, scale, offset, known, (float(low), float(high)))


def _number(said: Mapping[str, Any], name: str, plain: float, where: str) -> float:
    """A finite number that is said; `plain` where nothing is."""
    value = np.ravel(said.get(name, plain))
    if value.size != 1 or value.dtype.kind not in "uif" or not np.isfinite(value[0]):
        raise DataError(f"{where} has the attribute {name} {printable(str(value))[:_SHOWN]}; expected a finite number.")
    return float(value[0])
