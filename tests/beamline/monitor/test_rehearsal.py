"""A rehearsal compiles what the checks run in a scan, and changes nothing."""

from __future__ import annotations

import sys

import pytest

from beamline.core.jit import _Kernel
from beamline.monitor import rehearsal
from beamline.monitor.check import ScanContext
from beamline.monitor.rehearsal import rehearse
from beamline.monitor.watch import start

OF_REALS = {"_sum_reals", "_count_reals"}  # frames of other programs
# Compiled with the kernel that calls them.
IN_KERNELS = {"_clipped", "_product", "_smooth", "_weigh", "_folded", "_place", "_longest"}


@pytest.mark.parametrize("step", [float("nan"), 0.002])  # rad: a scan's may be that of the toy, or another
def test_a_rehearsal_runs_every_kernel_that_frames_of_counts_need(monkeypatch: pytest.MonkeyPatch, step: float) -> None:
    monkeypatch.setattr(rehearsal, "_REHEARSED", set())
    monitor = start(ScanContext(65535, 2048**2, period=0.1, step=step))
    kernels = {
        name: kernel
        for module in [m for name, m in sys.modules.items() if name.startswith("beamline.monitor.")]
        for name, kernel in vars(module).items()
        if isinstance(kernel, _Kernel) and name not in OF_REALS | IN_KERNELS
    }
    assert len(kernels) > 8
    ran, call = set[_Kernel](), _Kernel.__call__
    monkeypatch.setattr(_Kernel, "__call__", lambda kernel, *args: (ran.add(kernel), call(kernel, *args))[1])
    rehearse(monitor)
    assert {name for name, kernel in kernels.items() if kernel not in ran} == set()
    assert monitor.before is None and monitor.recent == ()


def test_the_next_scan_of_the_process_by_the_same_checks_waits_for_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monitor, looks = start(ScanContext(65535, 2048**2, period=0.1)), list[int]()
    look = rehearsal.look
    monkeypatch.setattr(rehearsal, "_REHEARSED", set())
    monkeypatch.setattr(rehearsal, "look", lambda *args: (looks.append(1), look(*args))[1])
    rehearse(monitor)
    first = len(looks)
    rehearse(start(ScanContext(4095, 512**2, step=0.5)))
    assert 0 < first == len(looks)
    rehearse(start(monitor.context, monitor.checks[1:]))
    assert len(looks) == 2 * first
