"""Kernels for CUDA devices, in Triton and torch: the CPU kernels' operations; imported only if a GPU is used.

They work on contiguous float32 torch tensors. Sums are gathered, never scattered. An image tile or a brick of voxels
sums the Gaussians on its list; a Gaussian sums the gradient under it. So there are no atomics, and the same input gives
the same bits. With TRITON_INTERPRET=1 in the environment, before the first import, the same kernels run on the CPU,
slowly, for tests.
"""

from __future__ import annotations

import os

# Triton 3.9 warns unless this is set, since its default will change; the kernels use fused multiply-adds.
os.environ.setdefault("TRITON_DEFAULT_FP_FUSION", "1")

try:
    import triton
except ImportError as error:
    raise ImportError(
        f"the GPU kernels need triton, which cannot be loaded here ({error}); install splatline[gpu] (Linux), or fit "
        "on the cpu"
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
        raise ValueError(f"the GPU kernels run on cuda devices, got {wanted}; take the CPU kernels for it")
    if not torch.cuda.is_available():
        raise RuntimeError(
            f"device {wanted} was asked for, but torch {torch.__version__} sees no CUDA device: check the driver and "
            "that this torch is a CUDA build, or fit on the cpu"
        )
    current, count = torch.cuda.current_device(), torch.cuda.device_count()
    if wanted.index is not None and not 0 <= wanted.index < count:
        raise ValueError(
            f"device {device} was asked for, and torch sees {count} CUDA device{'' if count == 1 else 's'}, counted "
            f"from 0: ask for cuda, which is cuda:{current}, or fit on the cpu"
        )
    if wanted.index not in (None, current):
        raise ValueError(
            f"device {wanted} was requested, but GPU kernels run only on the current one, cuda:{current}: start Python "
            f"with CUDA_VISIBLE_DEVICES={wanted.index} and ask for cuda"
        )
    return wanted
