"""Kernels for CUDA devices (Triton and torch) with the operations of the CPU kernels; imported only if a GPU is used.

They work on contiguous float32 torch tensors. A result gathers its sum, and no two programs write to one value: an
image tile or a brick of voxels sums the Gaussians in its list, and a Gaussian sums the gradient in its footprint. So
there are no atomics, and the same input gives bit-identical results. If TRITON_INTERPRET=1 is set in the environment
before the first import, the same kernels run slowly on the CPU, for tests.
"""

from __future__ import annotations

import os

# Triton 3.9 warns if this is not set, because its default will change; the kernels use fused multiply-adds.
os.environ.setdefault("TRITON_DEFAULT_FP_FUSION", "1")

try:
    import triton
except ImportError as error:
    raise ImportError(
        f"the GPU kernels need triton, which cannot be loaded ({error}). Install splatline[gpu] (Linux), or use "
        "device cpu"
    ) from error

import torch


def interpreted() -> bool:
    """Whether kernels run in Triton's interpreter, on CPU tensors."""
    return bool(triton.knobs.runtime.interpret)


def require(device: str | torch.device) -> torch.device:
    """The device to run on.

    Raises:
        ValueError: the device is not a CUDA device (and Triton is not interpreted), or not the current one.
        RuntimeError: torch sees no CUDA device.
    """
    wanted = torch.device(device)
    if interpreted():
        return torch.device("cpu")
    if wanted.type != "cuda":
        raise ValueError(
            f"the GPU kernels run only on cuda devices, got {wanted}; use the CPU kernels for device {wanted}"
        )
    if not torch.cuda.is_available():
        raise RuntimeError(
            f"cannot use device {wanted}: torch {torch.__version__} finds no CUDA device. Check the driver and that "
            "this torch is a CUDA build, or use device cpu"
        )
    current, count = torch.cuda.current_device(), torch.cuda.device_count()
    if wanted.index is not None and not 0 <= wanted.index < count:
        raise ValueError(
            f"there is no device {device}: torch finds {count} CUDA device{'' if count == 1 else 's'}, counted from "
            f"0. Use cuda, which is cuda:{current}, or cpu"
        )
    if wanted.index not in (None, current):
        raise ValueError(
            f"cannot use device {wanted}: the GPU kernels run only on the current device, cuda:{current}. Start "
            f"Python with CUDA_VISIBLE_DEVICES={wanted.index} and use cuda"
        )
    return wanted
