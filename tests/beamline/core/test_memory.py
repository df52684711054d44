"""Peak memory: it is bytes, it grows with what is held, and it does not fall again."""

from __future__ import annotations

import ctypes
import sys

import numpy as np
import pytest

from beamline.core.memory import _high_water, _ProcessMemoryCounters, forget_peak, peak_memory


@pytest.mark.skipif(sys.platform not in ("linux", "darwin", "win32"), reason="nothing is promised elsewhere")
def test_the_peak_is_bytes_and_stays() -> None:
    before = peak_memory()
    assert before is not None
    held = np.ones(int(before * 0.2 + 4e7) // 8)
    after = peak_memory()
    assert after is not None
    size = held.nbytes
    del held
    # What was free before may be taken up again, so that the peak grows by less than what is held.
    assert 10e6 < before <= after < before + 2 * size
    assert peak_memory() == pytest.approx(after, rel=0.2)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can do it")
def test_a_peak_can_be_forgotten() -> None:
    held = np.ones(40_000_000)  # 320 MB, given back at once: it is mapped memory
    high = peak_memory()
    del held
    forget_peak()
    low = peak_memory()
    assert high is not None and low is not None
    assert low < high - 2e8


def test_the_status_file_of_linux() -> None:
    assert _high_water("Name:\tpython\nVmPeak:\t  999 kB\nVmHWM:\t  1234 kB\n") == 1234 * 1024
    assert _high_water("Name:\tpython\n") is None


def test_the_structure_is_that_of_the_windows_headers() -> None:
    """PROCESS_MEMORY_COUNTERS: two DWORDs and eight SIZE_T."""
    assert ctypes.sizeof(_ProcessMemoryCounters) == 8 + 8 * ctypes.sizeof(ctypes.c_size_t)
    assert _ProcessMemoryCounters.PeakWorkingSetSize.offset == 8
