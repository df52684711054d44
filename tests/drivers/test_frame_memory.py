"""The memory of a frame is released when its last numpy view is gone, and not before."""

from __future__ import annotations

import numpy as np
import pytest

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


def test_prepared_memory_is_there_before_the_frames() -> None:
    """No page is got when a frame is written to it."""
    resource = pytest.importorskip("resource")
    shape = (2048, 8192)  # 32 MiB: 8192 pages of 4 KiB, where the system has no larger ones

    def faults_of_two_frames(memory: FrameMemory) -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        frames = [memory.take(shape) for _ in range(2)]
        for frame in frames:
            frame[:] = 1
        return int(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)

    unprepared = faults_of_two_frames(FrameMemory())
    memory = FrameMemory()
    memory.prepare(2, shape)
    assert faults_of_two_frames(memory) < 100
    if unprepared < 256:
        pytest.skip(f"{unprepared} faults without it: the system has pages so large that their number proves nothing")


def test_prepared_memory_is_used_again_and_more_is_got_when_it_is_out() -> None:
    memory = FrameMemory()
    memory.prepare(2, SHAPE)
    frames = [memory.take(SHAPE) for _ in range(3)]
    for i, frame in enumerate(frames):
        frame[:] = i
    assert [int(frame.max()) for frame in frames] == [0, 1, 2]
    first = {address(frame) for frame in frames}
    del frame, frames
    assert {address(frame) for frame in [memory.take(SHAPE) for _ in range(3)]} == first


def test_no_memory_is_an_error_that_leaves_it_as_new() -> None:
    memory = FrameMemory()
    with pytest.raises(MemoryError):
        memory.prepare(1, (2**30, 2**30))
    assert memory.take(SHAPE).shape == SHAPE
