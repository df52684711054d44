"""Activations and Adam: the Triton kernels compared with torch and the CPU kernels."""

from __future__ import annotations

import importlib

import numpy as np

from recon.splatting.backend import Cpu

engine = importlib.import_module("recon.kernels.gpu.engine")


def test_adam_and_its_bounds_equal_the_cpus(rng: np.random.Generator) -> None:
    shapes, rates = ((700, 3), (5, 3), (5, 4), (1,)), (0.01, 0.02, 0.003, 0.1)
    bounds = (None, (-0.5, 0.4), None, (0.1, 2.0))
    ours, theirs = Cpu(), engine.Gpu("cuda")
    start = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
    sets = [[[b.array(p) for p in start], *([b.array(0 * p) for p in start] for _ in range(2))] for b in (ours, theirs)]
    for step in range(1, 4):
        slopes = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
        for backend, (p, first, second) in zip((ours, theirs), sets, strict=True):
            backend.adam(p, [backend.array(slope) for slope in slopes], first, second, rates, step, bounds)
    held = theirs.numpy(sets[1][0][1])
    assert held.min() == np.float32(-0.5) and held.max() == np.float32(0.4)
    for mine, others in zip(*sets, strict=True):
        for a, b in zip(mine, others, strict=True):
            np.testing.assert_allclose(theirs.numpy(b), a, atol=2e-6)
