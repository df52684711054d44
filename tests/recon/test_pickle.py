"""Public values can be pickled and deep-copied, as worker processes and caches do."""

import copy
import pickle
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

import recon

_ANGLES = np.linspace(0, np.pi, 8, endpoint=False)
_VIEWS = recon.Geometry.parallel(_ANGLES, (4, 16))
_LINES = np.random.default_rng(0).random((8, 4, 16), np.float32) + 1
_GRID = recon.Grid.matching(_VIEWS)
_VOLUME = recon.Volume(_LINES[:4], recon.Grid((4, 4, 16), 1.0))
_GAUSSIANS = recon.Gaussians.from_physical(np.zeros((2, 3)), np.ones((2, 3)), np.ones(2), density_unit=1.0)
_ENERGIES = np.arange(8) % 2
_MADE: dict[str, Any] = {
    "AxisEstimate": recon.AxisEstimate(7.5, np.arange(3.0), np.ones(3), True, "moments"),
    "Counts": recon.Counts(_LINES, np.ones((4, 16), np.float32)),
    "DataUse": recon.DataUse(_LINES, (3,)),
    "EnergyViews": recon.EnergyViews(_LINES, _VIEWS, _ENERGIES, np.array([[1.0, 0.2], [0.3, 1.0]])),
    "Gaussians": _GAUSSIANS,
    "Geometry": _VIEWS,
    "Grid": _GRID,
    "Materials": recon.Materials(_LINES[None], _GRID, np.ones(1), 0.1),
    "Progress": recon.Progress(1, 2, 3.0, 0.1, 0.2, 5, 6),
    "Projections": recon.Projections(_LINES, np.arange(8), 0.0, _LINES[:, 0, 0], _LINES[0] > 0),
    "Projector": recon.Projector(_VIEWS, _GRID),
    "RayWidth": recon.RayWidth(blur=1.0),
    "References": recon.References(_LINES[0], ((0, _LINES[:3]),)),
    "RunControl": recon.RunControl(),
    "TimedViews": recon.TimedViews(_LINES, _VIEWS, np.arange(8.0)),
    "TimedVolumes": recon.TimedVolumes(np.arange(2.0), np.stack([_LINES, _LINES]), _GRID, 0.1),
    "Volume": _VOLUME,
    "WithoutRings": recon.WithoutRings(_LINES, _LINES[0], "None were found."),
}


def _of(name: str) -> Any:
    return _MADE[name] if name in _MADE else getattr(recon, name)()


def same(one: Any, other: Any) -> bool:
    """Alike to the last bit, and of one type."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray | torch.Tensor):
        return np.array_equal(np.asarray(one), np.asarray(other), equal_nan=np.asarray(one).dtype.kind == "f")
    if is_dataclass(one):
        return all(same(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))
    if isinstance(one, Mapping):
        return list(one) == list(other) and all(same(one[name], other[name]) for name in one)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other) or one != one  # NaN


@pytest.mark.parametrize("copied", [lambda value: pickle.loads(pickle.dumps(value)), copy.deepcopy])  # noqa: S301
class TestCopies:
    @pytest.mark.parametrize(
        "name",
        [name for name in recon.__all__ if is_dataclass(getattr(recon, name)) and name != "Reconstruction"],
    )
    def test_of_each_public_value(self, name: str, copied: Callable[[Any], Any]) -> None:
        value = _of(name)
        assert same(copied(value), value)

    def test_of_a_fit_that_goes_on(self, copied: Callable[[Any], Any]) -> None:
        fit = recon.StreamingFit(_VIEWS)
        fit.add_views(_LINES, _ANGLES)
        assert copied(fit).n_views == fit.n_views == 8

    def test_of_a_result(self, copied: Callable[[Any], Any]) -> None:
        plain = recon.reconstruct(_LINES, _VIEWS, recon.Fbp())
        full = replace(plain, gaussians=_GAUSSIANS, deviation=plain.volume, checkpoint={"at": _ANGLES})
        for result in (plain, full):
            assert same(copied(result), result)

    def test_of_what_a_wide_sample_adds_to_views(self, copied: Callable[[Any], Any]) -> None:
        result = recon.reconstruct(_LINES, _VIEWS, recon.Sirt(iterations=1), use=recon.DataUse(sample_radius=11.0))
        assert result.outside is not None and result.outside(_VIEWS).any()
        np.testing.assert_array_equal(copied(result).outside(_VIEWS), result.outside(_VIEWS))
