"""A rehearsal compiles what the checks run in a scan, and changes nothing."""

from __future__ import annotations

import sys

from beamline.core.jit import _Kernel
from beamline.monitor.check import ScanContext
from beamline.monitor.rehearsal import rehearse
from beamline.monitor.watch import start

OF_REALS = {"_sum_reals", "_count_reals"}  # frames of other programs
IN_KERNELS = {"_clipped", "_product", "_smooth", "_weigh", "_folded"}  # compiled with the kernel that calls them


def test_a_rehearsal_runs_every_kernel_that_frames_of_counts_need() -> None:
    monitor = start(ScanContext(65535, 2048**2, period=0.1))
    kernels = {
        name: kernel
        for module in [m for name, m in sys.modules.items() if name.startswith("beamline.monitor.")]
        for name, kernel in vars(module).items()
        if isinstance(kernel, _Kernel) and name not in OF_REALS | IN_KERNELS
    }
    assert len(kernels) > 8
    rehearse(monitor)
    assert {name for name, kernel in kernels.items() if not kernel.signatures} == set()
    assert monitor.before is None and monitor.recent == ()
