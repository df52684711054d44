"""Compares what `Reconstruction.save` writes with what `load` reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import recon


def comes_back(result: recon.Reconstruction, path: Path) -> None:
    """Save and load a result, and compare everything that the file contains."""
    result.save(path)
    loaded = recon.Reconstruction.load(path)
    np.testing.assert_array_equal(loaded.volume.data, result.volume.data)
    assert loaded.volume.data.dtype == np.float32 and loaded.volume.grid == result.volume.grid
    assert (loaded.method, loaded.seconds) == (result.method, result.seconds)
    assert repr(loaded.settings) == repr(_as_lists(result.settings))  # the text form also compares NaN
    assert (loaded.series is None) == (result.series is None)
    if loaded.series is not None and result.series is not None:
        np.testing.assert_array_equal(loaded.series.data, result.series.data)
        np.testing.assert_array_equal(loaded.series.seconds, result.series.seconds)


def _as_lists(value: Any) -> Any:
    """A setting with lists for tuples and arrays, and text for other objects."""
    if isinstance(value, dict):
        return {name: _as_lists(each) for name, each in value.items()}
    if isinstance(value, tuple | list):
        return [_as_lists(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value if isinstance(value, int | float | None) else str(value)
