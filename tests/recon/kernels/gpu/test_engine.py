"""A fit is the same on both backends, calls run on the device of their tensors, and errors name what is missing."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest
import torch

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel, Truncation
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting import optimise as fit
from recon.splatting.backend import Backend, Cpu, backend_for
from recon.splatting.checkpoint import arrays_of, state_from
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import NAMES, DensityPolicy, FitSettings
from tests.messages import refused
from tests.recon.conftest import Make
from tests.recon.helpers import run_steps
from tests.recon.kernels.gpu.on_gpu import UNIT, cone, parallel

gpu = importlib.import_module("recon.kernels.gpu")


def _fit(
    backend: Backend[Any], g: Gaussians, geometry: Geometry, settings: FitSettings
) -> tuple[fit.FitState, list[Any]]:
    """Three steps with a round of density control on data and weights that are always the same."""
    rng = np.random.default_rng(5)
    data = rng.random((geometry.n_views, *geometry.detector_shape)).astype(np.float32)
    weights = (rng.random(data.shape) > 0.1).astype(np.float32)
    problem = fit.problem_of(Views(data, geometry, weights), Grid.matching(geometry), UNIT, settings, backend)
    state, records = fit.init(g, 11, 1.5, backend), []
    run_steps(
        state, problem, settings, 3, lambda s: records.append((s.n, float(s.loss), float(s.residual))) is not None
    )
    return state, [*records, fit.misfit_of(state, problem, settings)]


LONG = (pytest.mark.slow, pytest.mark.long)


@pytest.mark.parametrize(
    ("make", "kernel", "changes"),
    [
        (parallel, Kernel.GAUSSIAN, {"loss": "poisson", "views_per_step": 2}),
        pytest.param(cone, Kernel.COMPACT, {"loss": "l1", "rays": RayModel(exact_above=0.05)}, marks=LONG),
    ],
)
def test_a_fit_is_the_same_on_both_backends(
    make: object, kernel: Kernel, changes: dict[str, Any], random_gaussians: Make
) -> None:
    g, geometry = random_gaussians(14, 6.0, kernel=kernel), make((11, 14))  # type: ignore[operator]
    # The CPU's sixteen lanes reach past a box's end; without truncation only rounding is left.
    policy = DensityPolicy(start=0.0, stop=1.0, every=2, threshold=1e-4, prune_below=0.3)
    settings = FitSettings(
        truncation=Truncation(9.0, 1e-12), policy=policy, tv_size=5, pace=10.0, smallest=0.8, **changes
    )
    (ours, our_records), (theirs, their_records) = (
        _fit(backend, g, geometry, settings) for backend in (Cpu(), backend_for("cuda"))
    )
    assert len({n for n, *_ in our_records[:-1]}) > 1  # density control changed the model
    np.testing.assert_allclose(np.hstack(their_records), np.hstack(our_records), rtol=2e-5)
    device = backend_for("cuda")
    for name in NAMES:
        a, b = ours.parameters[name], device.numpy(theirs.parameters[name])
        np.testing.assert_allclose(b, a, atol=2e-5 * float(np.abs(a).max()), err_msg=name)
    np.testing.assert_allclose(device.numpy(theirs.statistic), ours.statistic, atol=2e-5 * ours.statistic.max())
    checkpoint = arrays_of(theirs, device)
    again = state_from(checkpoint, device)
    for key, array in arrays_of(again, device).items():
        np.testing.assert_array_equal(array, checkpoint[key], err_msg=key)


def test_errors_say_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "interpreted", lambda: False)
    with refused(ValueError):
        gpu.require("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(RuntimeError, match="finds no CUDA device"):
        gpu.require("cuda:1")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with refused(ValueError):
        gpu.require("cuda:1")
    for absent in ("cuda:2", "cuda:200"):  # torch takes the latter for a device of negative number
        with pytest.raises(ValueError, match=r"finds 2 CUDA.*Use cuda"):
            gpu.require(absent)
    assert gpu.require("cuda:0") == torch.device("cuda:0")
