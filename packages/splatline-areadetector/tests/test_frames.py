"""NTNDArrays become frames: decoded pixels, window, attributes; and the stream of frames."""

from __future__ import annotations

import io
import json
import signal
import sys
import time
import tracemalloc
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import pytest
from fake_ioc import FakeIoc, array_value, counts_of

from beamline.core.errors import ConfigError
from splatline_areadetector.arrays import ArrayFrame, FrameRefusedError, Window, array_frame, decoded
from splatline_areadetector.receiver import Receiver, frame_of
from splatline_areadetector.stream import Died, FrameStream, Item, Overflow, Queues, Refused, image_problem

SMOOTH = np.arange(256 * 128).reshape(256, 128) // 300
CODECS = {  # the filter of HDF5, and the bytes of its header that areaDetector leaves out
    "bslz4": (hdf5plugin.Bitshuffle(), 12),
    "lz4": (hdf5plugin.LZ4(), 16),
    "lz4hdf5": (hdf5plugin.LZ4(), 0),
    "blosc": (hdf5plugin.Blosc(), 0),
}


def _compressed(codec: str, counts: np.ndarray) -> np.ndarray:
    """As a file has it, without the header."""
    made_by, header = CODECS[codec]
    with h5py.File("made", "w", driver="core", backing_store=False) as file:
        held = file.create_dataset("made", data=counts, chunks=counts.shape, **made_by)
        mask, chunk = held.id.read_direct_chunk((0, 0))
    assert mask == 0  # it was compressed
    return np.frombuffer(chunk, np.uint8)[header:]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("codec", CODECS)
def test_codecs(codec: str, dtype: Any) -> None:
    counts = SMOOTH.astype(dtype)
    value = array_value(
        _compressed(codec, counts)[None], 3, codec={"name": codec, "parameters": {np.uint8: 5, np.uint16: 6}[dtype]}
    )
    value.dimension = [{"size": n, "offset": 0, "fullSize": n, "binning": 1, "reverse": False} for n in (128, 256)]
    frame = array_frame(value, 0.0)
    assert frame is not None and frame.codec == codec and np.array_equal(frame.counts(), counts)
    assert frame.counts().dtype == np.uint16


def test_chunks_of_a_file_with_their_header_are_decoded_too() -> None:
    with h5py.File("made", "w", driver="core", backing_store=False) as file:
        held = file.create_dataset("made", data=SMOOTH, chunks=SMOOTH.shape, dtype="u2", **hdf5plugin.Bitshuffle())
        _, chunk = held.id.read_direct_chunk((0, 0))
    assert np.array_equal(decoded("bslz4", np.frombuffer(chunk, np.uint8), SMOOTH.shape, np.dtype("u2")), SMOOTH)


def test_a_damaged_frame_says_so() -> None:
    with pytest.raises(ValueError, match="the bslz4 pixels cannot be decoded"):
        decoded("bslz4", np.zeros(20, np.uint8), (4, 4), np.dtype("u2"))


@pytest.mark.parametrize("sides", [(0, 16), (24, 0), (0, 0), (65536, 65536), (10**9, 1), (20000, 20000)])
@pytest.mark.parametrize("codec", ["", *CODECS])
def test_sizes_that_no_frame_has_are_refused_before_memory_is_taken(codec: str, sides: tuple[int, int]) -> None:
    value = array_value(np.zeros((2, 2048), np.uint16 if not codec else np.uint8), 1)
    if codec:
        value.codec = {"name": codec, "parameters": 6}
    value.dimension = [{"size": n, "offset": 0, "fullSize": n, "binning": 1, "reverse": False} for n in sides]
    began = time.monotonic()
    with pytest.raises(FrameRefusedError, match=f"the frame is wrong: {sides[1]} x {sides[0]} pixels of uint16"):
        array_frame(value, 0.0)
    assert time.monotonic() - began < 1


@pytest.mark.parametrize("codec", CODECS)
def test_pixels_that_a_message_cannot_hold_are_not_looked_for(codec: str) -> None:
    tracemalloc.start()
    with pytest.raises(
        ValueError, match=r"pixels cannot be decoded, because the compressed data hold fewer than 16384 x 16384"
    ):
        decoded(codec, np.ones(4096, np.uint8), (16384, 16384), np.dtype("u2"))
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_window_and_attributes() -> None:
    value = array_value(counts_of(4), 4, {"SampleRotary": 12.5}, seconds=1.7e9 + 0.25)
    sides = ((24, 6, 2, True), (16, 10, 2, False))
    value.dimension = [{"size": n, "offset": o, "fullSize": n, "binning": b, "reverse": r} for n, o, b, r in sides]
    frame = array_frame(value, 5.0)
    assert frame is not None and frame.window == Window((16, 24), (10, 6), (2, 2), (False, True))
    assert (frame.unique_id, frame.received) == (4, 5.0) and frame.time == pytest.approx(1.7e9 + 0.25)
    assert frame.attributes == {"ColorMode": 0, "SampleRotary": 12.5}
    assert np.array_equal(frame.counts(), counts_of(4))


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"codec": {"name": "zfp", "parameters": 6}}, "with zfp, which this program cannot decode; set Codec1:Comp"),
        ({"codec": {"name": "blosc", "parameters": 0}}, "frames with the codec blosc do not state the type"),
        ({"attributes": {"ColorMode": 1}}, "the pixels are Bayer, but only single-colour images"),
    ],
)
def test_what_is_no_frame_of_counts(changed: dict[str, Any], sentence: str) -> None:
    with pytest.raises(FrameRefusedError, match=sentence):
        array_frame(array_value(counts_of(1), 1, **changed), 0.0)


def test_three_axes_and_wide_integers_are_refused() -> None:
    for counts, sentence in ((np.zeros((3, 4, 4), np.uint16), "dimensions"), (np.zeros((4, 4), np.uint32), "uint32")):
        with pytest.raises(FrameRefusedError, match=sentence):
            array_frame(array_value(counts, 1), 0.0)


def test_the_queue_is_about_a_second_and_at_most_512_mb() -> None:
    queues = Queues()
    assert queues.frames(43_200, 0.02) == 51 and queues.frames(43_200, None) == 100
    assert queues.frames(8_388_608, 0.01) == 61 and queues.frames(400_000_000, 0.1) == 4


def test_addresses() -> None:
    assert image_problem("ca://P:Pva1:Image") and image_problem("pva://") and not image_problem("pva://P:Pva1:Image")
    with pytest.raises(ConfigError, match="is not the address of an image; expected pva://PREFIX:Pva1:Image"):
        FrameStream("P:Pva1:Image")


def _taken(stream: FrameStream, n: int) -> list[Item]:
    items = [stream.next(5.0) for _ in range(n)]
    assert all(item is not None for item in items)
    return [item for item in items if item is not None]


@pytest.mark.usefixtures("loopback")
def test_a_stream_marks_what_was_there_and_survives_what_it_cannot_read() -> None:
    with FakeIoc() as ioc:
        ioc.post(array_value(counts_of(5), 5))
        with FrameStream(ioc.url) as stream:
            ioc.post(array_value(np.zeros((4, 4)), 6))
            ioc.post(array_value(counts_of(7), 7))
            old, refused, new = _taken(stream, 3)
            assert isinstance(old, ArrayFrame) and old.is_current and stream.first is not None
            assert isinstance(refused, Refused) and refused.unique_id == 6 and "float64" in refused.why
            assert isinstance(new, ArrayFrame) and not new.is_current and stream.answers()
            stream.put_back(new)
            assert stream.next(0.0) is new and stream.next(0.05) is None


def test_an_update_that_cannot_be_read_ends_nothing() -> None:
    """An exception in p4p's callback would end the subscription with a line in a log."""
    receiver, passed = Receiver(10_000), io.BytesIO()
    for value in (object(), array_value(counts_of(2), 2)):
        receiver.take(value)
    for _ in range(3):
        receiver.pass_on(passed)
    passed.seek(0)
    refused, ready = (json.loads(passed.readline()) for _ in range(2))
    assert refused[0] == "refused" and "AttributeError" in refused[2] and ready == ["ready"]
    frame = frame_of(passed, json.loads(passed.readline())[1])
    assert frame.unique_id == 2 and np.array_equal(frame.counts(), counts_of(2))


def test_frames_wait_up_to_a_limit_and_one_always_may() -> None:
    size = counts_of(1).nbytes
    for room, ids in ((2 * size, [1, 2]), (1, [1])):
        receiver, passed = Receiver(room), io.BytesIO()
        for unique_id in range(1, 5):
            receiver.take(array_value(counts_of(unique_id), unique_id))
        for _ in range(5):
            receiver.pass_on(passed)
        receiver.take(array_value(counts_of(5), 5))  # there is room again
        receiver.pass_on(passed)
        passed.seek(0)
        told = list[tuple[str, int]]()
        while line := passed.readline():
            what, *facts = json.loads(line)
            if what == "frame":
                told.append((what, frame_of(passed, facts[0]).unique_id))
            elif what == "overflow":
                told.append((what, facts[0]))
        lost = [("overflow", i) for i in range(len(ids) + 1, 5)]
        assert told == [*(("frame", i) for i in ids), *lost, ("frame", 5)]


@pytest.mark.usefixtures("loopback")
def test_a_receiver_that_dies_is_replaced_and_frames_that_are_held_stay(loopback: dict[str, str]) -> None:
    with FakeIoc() as ioc, FrameStream(ioc.url) as stream:
        ioc.send(range(1, 3))
        _, first, second = _taken(stream, 3)
        stream._process.kill()
        died, current = stream.next(5.0), stream.next(20.0)
        ioc.send(range(3, 5))
        third, fourth = _taken(stream, 2)
        held = [item for item in (first, second, third, fourth) if isinstance(item, ArrayFrame)]
        assert isinstance(died, Died) and isinstance(current, ArrayFrame) and current.is_current
        assert [frame.unique_id for frame in held] == [1, 2, 3, 4] and len(stream.still) == 1
    assert all(np.array_equal(frame.counts(), counts_of(frame.unique_id)) for frame in held)


@pytest.mark.usefixtures("loopback")
def test_several_clients_lose_nothing_and_what_had_no_room_is_named() -> None:
    """Frames of 2 MB. Of the one client all wait, and keep their pixels, although its receiver is stopped for a moment;
    of the other one does, beside those in the pipe and in this process."""
    frames = [np.full((1024, 1024), i, np.uint16) for i in range(1, 31)]
    with FakeIoc() as ioc, FrameStream(ioc.url) as whole, FrameStream(ioc.url, Queues(ring_megabytes=2.5)) as stream:
        for unique_id, counts in enumerate(frames, 1):
            ioc.post(array_value(counts, unique_id))
            time.sleep(0.02)
            if unique_id == 20 and sys.platform != "win32":  # it waits to write then
                whole._process.send_signal(signal.SIGSTOP)
                time.sleep(0.1)
                whole._process.send_signal(signal.SIGCONT)
        come = [item for item in _taken(whole, 31) if isinstance(item, ArrayFrame) and not item.is_current]
        items = _taken(stream, 1)
        while items[-1] != Overflow(30):
            items += _taken(stream, 1)
    assert [frame.unique_id for frame in come] == [*range(1, 31)]
    assert all((frame.counts() == frame.unique_id).all() for frame in come)
    numbers = [item.unique_id for item in items if isinstance(item, ArrayFrame | Overflow)]
    assert [i for i in numbers if i] == [*range(1, 31)] and isinstance(items[1], ArrayFrame)
