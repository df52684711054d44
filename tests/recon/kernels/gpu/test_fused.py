"""Complete steps on the device: too short lists are repeated; a graph is bit-identical to its launches."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest
import torch

from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting import optimise as fit
from recon.splatting.backend import backend_for
from recon.splatting.gaussians import Gaussians
from recon.splatting.problem import FitProblem
from recon.splatting.settings import NAMES, FitSettings
from tests.recon.kernels.gpu.on_gpu import UNIT

fused, tiles = (importlib.import_module(f"recon.kernels.gpu.{name}") for name in ("engine", "tiles"))
SETTINGS = FitSettings(policy=None, tv_size=5, tv_weight=0.05, views_per_step=2)


def _fused(state: fit.FitState) -> Any:
    return state.fused


def _start(shape: tuple[int, int] = (8, 24), n: int = 16, wide: float = 0.5) -> tuple[fit.FitState, FitProblem]:
    rng, backend = np.random.default_rng(3), backend_for("cuda")
    geometry = Geometry.parallel(np.linspace(0, np.pi, 7, endpoint=False), shape)
    data = rng.random((7, *shape)).astype(np.float32)
    rows, cols = shape
    model = Gaussians.from_physical(
        (rng.random((n, 3)) - 0.5) * 0.8 * np.array([cols, cols, rows]),
        np.full((n, 3), wide),
        rng.uniform(0.2, 1, n),
        density_unit=UNIT,
    )
    problem = fit.problem_of(Views(data, geometry), Grid.matching(geometry), UNIT, SETTINGS, backend)
    return fit.init(model, 4, backend=backend), problem


def _arrays(state: fit.FitState) -> list[np.ndarray]:
    fit.settle(state)
    groups = state.parameters, state.first, state.second
    return [*(group[name].cpu().numpy() for group in groups for name in NAMES), state.statistic.cpu().numpy()]


def test_steps_whose_lists_were_too_short_are_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles, "_BLOCK", 32)  # so that few Gaussians fill a list
    found = []
    for settled in (True, False):  # settled: each step has long enough lists before the next one is queued
        state, problem = _start()
        for step in range(3):
            fit.step(state, problem, SETTINGS, 0.5)
            if step == 0:
                fit.settle(state)
                before = [room.pairs for room in _fused(state)._rooms]
                state.parameters["log_scales"] += 1.5  # footprints are four times as wide, lists longer than a room
            elif settled:
                fit.settle(state)
        found.append((_arrays(state), float(state.loss), float(state.residual)))
        after = [room.pairs for room in _fused(state)._rooms]
        assert after[0] > before[0]
    for ours, theirs in zip(found[0][0], found[1][0], strict=True):
        np.testing.assert_allclose(theirs, ours, atol=2e-5 * float(np.abs(ours).max()))
    np.testing.assert_allclose(found[1][1:], found[0][1:], rtol=1e-6)


@pytest.mark.gpu
def test_a_graph_gives_the_bits_of_its_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    found = []
    for launched in (False, True):
        monkeypatch.setattr(fused, "interpreted", lambda launched=launched: launched)
        state, problem = _start((96, 96), n=3000, wide=1.5)
        for _ in range(300):
            fit.step(state, problem, SETTINGS, 0.5)
        found.append((_arrays(state), float(state.loss), float(state.residual)))
        assert (_fused(state)._graph is None) == launched
    for ours, theirs in zip(found[0][0], found[1][0], strict=True):
        np.testing.assert_array_equal(theirs, ours)
    assert found[1][1:] == found[0][1:]
