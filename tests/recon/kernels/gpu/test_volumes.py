"""Operations on volumes and projections: torch on a device compared with the CPU kernels."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.overrides import TorchFunctionMode

from recon.kernels.cpu import patches, tents, tv, vectors
from recon.kernels.cpu.spread import passes_of, spread
from recon.voxels.devices import CPU
from tests.recon.kernels.gpu.on_gpu import DEVICE

volumes = importlib.import_module("recon.kernels.gpu.volumes")
F32 = NDArray[np.float32]
Shape = tuple[int, int, int]
gpu = volumes.GpuVolumes("cuda")

ULP = float(np.finfo(np.float32).eps)  # of float32, relative to the largest value
SHAPES = [(7, 6, 1), (6, 9, 2), (5, 8, 3), (9, 7, 13), (2, 3, 17), (1, 5, 6), (6, 1, 5), (1, 1, 1)]
WEIGHTS = (1.0, 0.8, 1.3)  # of voxels that are no cubes
BACKS = [(0, 0), (1, 0), (0, 1), (1, 1)]


def drawn(rng: np.random.Generator, shape: tuple[int, ...], count: int) -> list[F32]:
    return [rng.normal(0.2, 1, shape).astype(np.float32) for _ in range(count)]


def assert_close(found: torch.Tensor, expected: F32, ulps: float) -> None:
    """Within so many ulp of the largest value expected."""
    assert found.device.type == DEVICE.type and found.dtype == torch.float32 and not found.requires_grad
    assert found.shape == expected.shape
    np.testing.assert_allclose(gpu.numpy(found), expected, rtol=0, atol=ulps * ULP * float(np.abs(expected).max()))


def test_arrays_are_copied_to_the_device_and_back(rng: np.random.Generator) -> None:
    values = drawn(rng, (3, 4, 5), 1)[0]
    there = gpu.array(values.T)
    assert there.device.type == DEVICE.type and there.is_contiguous()
    back = gpu.numpy(there)
    np.testing.assert_array_equal(back, values.T)
    turned = gpu.numpy(there.permute(2, 1, 0))
    np.testing.assert_array_equal(turned, values)
    assert turned.flags.c_contiguous
    there += 1
    np.testing.assert_array_equal(back, values.T)
    assert not gpu.zeros((2, 3)).any() and gpu.zeros((2, 3)).shape == (2, 3)


@pytest.mark.parametrize("at_once", [1, 1 << 20])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("scaled", [False, True])
def test_residuals_and_their_sums_are_the_cpus(
    weighted: bool, scaled: bool, at_once: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(volumes, "_AT_ONCE", at_once)
    data, model = drawn(rng, (7, 11, 30), 2)
    weight, scale = (rng.uniform(0, 2, data.shape).astype(np.float32) if has else None for has in (weighted, scaled))
    views, there = gpu.array(data), gpu.array(model)
    found = gpu.replace_by_residual(views, there, *(None if s is None else gpu.array(s) for s in (weight, scale)))
    assert found == pytest.approx(vectors.replace_by_residual(data, model, weight, scale), rel=1e-6)
    assert type(found) is float
    np.testing.assert_array_equal(gpu.numpy(there), model)


@pytest.mark.parametrize("at_once", [1, 1 << 20])
def test_the_turn_of_steps_is_the_cpus(at_once: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(volumes, "_AT_ONCE", at_once)
    given = drawn(rng, (7, 11, 30), 3)
    found, size = gpu.turn_of_steps(*map(gpu.array, given)), float(np.prod(given[0].shape))
    assert found == pytest.approx(vectors.turn_of_steps(*given), abs=1e-6 * size)
    assert type(found) is float and abs(found) > 1e-2 * size


@pytest.mark.parametrize("at_once", [1, 1 << 20])
def test_products_and_norms_are_the_cpus(
    at_once: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(volumes, "_AT_ONCE", at_once)
    a, b = drawn(rng, (7, 11, 30), 2)
    assert gpu.dot(gpu.array(a), gpu.array(b)) == pytest.approx(vectors.dot(a, b), rel=1e-5)
    assert gpu.norm(gpu.array(a)) == pytest.approx(vectors.norm(a), rel=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("width", [1, 2, 3, 8])
def test_sums_in_coarse_cells_and_what_they_add_are_the_cpus(
    shape: Shape, width: int, rng: np.random.Generator
) -> None:
    x = drawn(rng, shape, 1)[0]
    there, expected = gpu.array(x), tents.tent_sums(x, width)
    sums = gpu.tent_sums(there, width)
    assert_close(sums, expected, 32)
    np.testing.assert_array_equal(gpu.numpy(there), x)
    gpu.add_tents(there, -0.7, sums, width)
    tents.add_tents(x, -0.7, expected, width)
    assert_close(there, x, 64)


@pytest.mark.parametrize("shape", [(8, 6, 3), (7, 5, 2), (1, 4, 5), (1, 1, 2)])
def test_filtered_cells_are_the_cpus(shape: Shape, rng: np.random.Generator) -> None:
    cells = drawn(rng, shape, 1)[0]
    transfer = rng.uniform(0, 1, (shape[0], shape[1] // 2 + 1)).astype(np.float32)
    assert_close(gpu.filtered(gpu.array(cells), transfer), CPU.filtered(cells, transfer), 16)


def test_sums_are_of_float64() -> None:
    model = np.zeros((2, 3, 700), np.float32)
    data = np.full_like(model, 0.1)
    data[0, 0, 0] = 1e4
    expected = float(np.square(data, dtype=np.float64).sum())
    assert gpu.replace_by_residual(gpu.array(data), gpu.array(model)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("shape", [(4, 9, 7), (4, 1, 6), (4, 5, 1)])
@pytest.mark.parametrize("scale", [(1.0, 1.0), (1.0, 0.0), (0.0, 1.0), (0.0, 0.0), (4.0, -3.0)])
def test_views_spread_as_on_the_cpu(shape: Shape, scale: tuple[float, float], rng: np.random.Generator) -> None:
    lines = drawn(rng, shape, 1)[0]
    variances = [factor * rng.uniform(0, 0.4, len(lines)) for factor in scale]
    there = gpu.array(lines)
    assert_close(gpu.spread(there, *variances), spread(lines, *variances), 4 * max(1, passes_of(*variances)))
    np.testing.assert_array_equal(gpu.numpy(there), lines)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("back", BACKS)
@pytest.mark.parametrize("nonnegative", [False, True])
def test_dual_steps_and_the_primal_point_are_the_cpus(
    shape: Shape, back: tuple[int, int], nonnegative: bool, rng: np.random.Generator
) -> None:
    x, given = drawn(rng, shape, 1)[0], (0.3, WEIGHTS, nonnegative)
    there, expected, found = gpu.array(x), tv.dual_field(shape), gpu.dual_field(shape)
    scratch, none = tv.dual_scratch(shape), gpu.dual_scratch(shape)
    for n in range(6):
        if n == 4:  # what belongs together changes, and the fields stay
            back = back[1], 1 - back[0]
        tv.dual_step(x, expected, *given, scratch, back)
        gpu.dual_step(there, found, *given, none, back)
    for axis, (mine, wanted) in enumerate(zip(found, expected, strict=True)):
        # |p| <= 1, and a step takes differences of x times 0.4 / 0.3: their rounding stays
        np.testing.assert_allclose(gpu.numpy(mine), wanted, rtol=0, atol=6 * ULP)
        assert not mine.narrow(axis, shape[axis] - 1, 1).any()
    np.testing.assert_array_equal(gpu.numpy(there), x)
    out, wanted = gpu.zeros(shape), np.empty_like(x)
    tv.primal(x, expected, *given, scratch, wanted)
    gpu.primal(there, found, *given, none, out)
    assert_close(out, wanted, 4)
    gpu.primal(there, found, *given, none, there)
    assert torch.equal(there, out)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("threshold", [0.0, 0.4, 3.0])
@pytest.mark.parametrize("nonnegative", [False, True])
def test_patches_are_the_cpus(shape: Shape, threshold: float, nonnegative: bool, rng: np.random.Generator) -> None:
    x, expected = drawn(rng, shape, 1)[0], np.empty(shape, np.float32)
    # No coefficient lies so near the threshold that its rounding decides.
    patches.denoise(x, threshold, nonnegative, patches.patch_scratch(shape), expected)
    there, out = gpu.array(x), gpu.zeros(shape)
    gpu.denoise(there, threshold, nonnegative, gpu.patch_scratch(shape), out)
    assert_close(out, expected, 8)
    np.testing.assert_array_equal(gpu.numpy(there), x)
    gpu.denoise(there, threshold, nonnegative, None, there)
    assert torch.equal(there, out)


@pytest.mark.parametrize("shape", [(19, 6, 13), (19, 6, 3)])
@pytest.mark.parametrize("planes", [1, 2, 5])
def test_patches_in_parts_have_the_bits_of_one_part(
    shape: Shape, planes: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, whole, parts = gpu.array(drawn(rng, shape, 1)[0]), gpu.zeros(shape), gpu.zeros(shape)
    gpu.denoise(x, 0.7, False, None, whole)
    plane = 4 * volumes._BLOCK_COPIES * (shape[1] + 6) * (shape[2] + 6)
    monkeypatch.setattr(volumes, "_AT_ONCE", planes * plane)
    gpu.denoise(x, 0.7, False, None, parts)
    assert torch.equal(parts, whole)


class OneDevice(TorchFunctionMode):
    """Refuses an operation on tensors of two devices."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = (*args, *(kwargs or {}).values())
        assert len({value.device for value in given if isinstance(value, torch.Tensor)}) < 2, func
        return func(*args, **(kwargs or {}))


@pytest.mark.slow  # the first operation on such a device loads much of torch
@pytest.mark.parametrize("shape", [(9, 7, 13), (6, 5, 3)])
def test_operations_stay_on_their_device_and_only_sums_wait_for_it(shape: Shape) -> None:
    """On a device without numbers, from which torch gives none to the host."""
    x, y, z, change = (torch.empty(shape, device="meta") for _ in range(4))
    p, variances = (x.clone(), x.clone(), x.clone()), np.full(shape[0], 0.9)
    with OneDevice():
        gpu.combine(0.5, x, 0.3, y, z)
        gpu.extrapolate(x, 0.3, y, z)
        gpu.dual_step(x, p, 0.3, WEIGHTS, True, None, (1, 1))
        gpu.primal(x, p, 0.3, WEIGHTS, True, None, x)
        gpu.denoise(x, 0.3, True, None, x)
        gpu.pulled_step(x, change, 0.1, 0.2, y, 0.03, z, True)
        assert gpu.spread(x, variances, -variances).device == x.device
        with pytest.raises(RuntimeError, match="item"):
            gpu.replace_by_residual(x, y, z)
        with pytest.raises(RuntimeError, match="item"):
            gpu.turn_of_steps(x, y, z)
        with pytest.raises(AssertionError):
            gpu.combine(1.0, x, 1.0, torch.zeros(shape), z)
