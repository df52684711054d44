"""Voxelisation and its backward pass compared with the float64 reference: anisotropic voxels, needles, small boxes."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from recon.kernels.cpu.voxelize import Layout
from tests.recon.kernels import reference

F32 = NDArray[np.float32]
Model = tuple[F32, F32, F32, F32]


def _model(rng: np.random.Generator, n: int, low: float = 0.6, high: float = 3.0) -> tuple[Model, F32]:
    """Means, scales, rotations [n, 9], densities; and the quaternions that the rotations come from."""
    means = rng.uniform(-6, 6, (n, 3)).astype(np.float32)
    scales = np.exp(rng.uniform(np.log(low), np.log(high), (n, 3))).astype(np.float32)
    quaternions = rng.normal(size=(n, 4)).astype(np.float32)
    rotations = reference.rotation_matrices(torch.from_numpy(quaternions)).reshape(n, 9).numpy()
    return (means, scales, np.ascontiguousarray(rotations), rng.uniform(0.2, 1, n).astype(np.float32)), quaternions


def test_only_gaussians_that_meet_the_box_are_placed(rng: np.random.Generator) -> None:
    # More than one task of the search, most of it outside, in the order of the model.
    model, _ = _model(rng, 3000, 0.3, 0.6)
    model[0][:] = rng.uniform(-100, 100, (3000, 3))
    shape, origin = (10, 11, 12), (3.0, -20.0, 40.0)
    layout = Layout(model, origin, 2.0, shape, 1e-6, 3.5)
    low, high = np.array(origin), np.array(origin) + 2.0 * (np.array(shape[::-1]) - 1)
    reach = 3.5 * np.sqrt(((model[2].reshape(-1, 3, 3) * model[1][:, None, :]) ** 2).sum(2))
    expected = np.flatnonzero(((model[0] + reach >= low) & (model[0] - reach <= high)).all(1))
    # Those that lie between two slices are met by none.
    assert set(layout.hits) <= set(expected) and np.all(np.diff(layout.hits) > 0)
    assert len(layout.hits) > 0
    brute = Layout(
        (model[0][expected], model[1][expected], model[2][expected], model[3][expected]), origin, 2.0, shape, 1e-6, 3.5
    )
    np.testing.assert_array_equal(layout.fill(), brute.fill())


def test_nothing_to_place_is_an_empty_volume() -> None:
    nothing = tuple(np.empty(s, np.float32) for s in ((0, 3), (0, 3), (0, 9), (0,)))
    far = tuple(np.full(s, 1e6, np.float32) for s in ((2, 3), (2, 3), (2, 9), (2,)))
    faint = tuple(np.ones(s, np.float32) for s in ((2, 3), (2, 3), (2, 9), (2,)))
    for model, limit in ((nothing, 0.0), (far, 1e9), (faint, 2.0)):
        layout = Layout((model[0], model[1], model[2], model[3]), (0.0, 0.0, 0.0), 1.0, (3, 4, 5), limit, 3.5)
        assert layout.hits.size == 0 and not layout.fill().any()
        into = [np.zeros_like(a) for a in (model[0], model[1], model[2], model[3])]
        layout.backward(np.ones((3, 4, 5), np.float32), *into)
        assert not any(a.any() for a in into)
