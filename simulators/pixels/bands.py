"""Bands: divides the rows of a frame among threads; results do not depend on their number."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

from recon.base.jit import thread_count

SMALL = 1 << 16  # Number of pixels below which threads cost more time than they save


def share_rows(work: Callable[[int, int], None], shape: tuple[int, int], bands: int = 1) -> None:
    """Call `work(first, end)` for bands that cover all rows of a frame of `shape`, in NUMBA_NUM_THREADS threads (by
    default one a core); `work` releases the interpreter's lock. The threads are not numba's own, because two threads
    must not use numba's threads at once, and a camera is read while other threads compute. `bands`: number of bands of
    each thread; give several if the work differs between rows."""
    threads = thread_count() if shape[0] * shape[1] > SMALL else 1
    if threads == 1:
        return work(0, shape[0])
    bands *= threads
    edges = [shape[0] * k // bands for k in range(bands + 1)]
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(work, first, end) for first, end in pairwise(edges)]:
            done.result()
    return None
