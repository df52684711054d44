"""Memory of frames comes back when the last view of a frame is gone, and not before."""

from __future__ import annotations

import numpy as np

from drivers.frame_memory import FrameMemory

SHAPE = (3, 5)


def address(array: np.ndarray) -> int:
    return int(array.__array_interface__["data"][0])


def test_memory_is_used_again_when_nobody_holds_a_frame() -> None:
    memory = FrameMemory()
    frame = memory.take(SHAPE)
    assert (frame.shape, frame.dtype, frame.flags.c_contiguous, frame.flags.writeable) == (SHAPE, "<u2", True, True)
    before = address(frame)
    del frame
    assert address(memory.take(SHAPE)) == before


def test_a_view_of_a_view_keeps_the_memory() -> None:
    memory = FrameMemory()
    frame = memory.take(SHAPE)
    frame[:] = 7
    held = frame[1:].view()[:, 2:].T
    del frame
    others = [memory.take(SHAPE) for _ in range(4)]
    for other in others:
        assert not np.shares_memory(other, held)
        other[:] = 9
    assert (held == 7).all()


def test_frames_of_another_size_have_memory_of_their_own() -> None:
    memory = FrameMemory()
    small = memory.take((2, 2))
    large = memory.take((4, 4))
    large[:] = 5
    del small
    again = memory.take((4, 4))
    again[:] = 6
    assert (large == 5).all() and again.shape == (4, 4)
