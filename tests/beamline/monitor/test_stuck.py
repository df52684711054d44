"""A frame that comes twice is flagged; frames without noise are not held against a simulation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from beamline.monitor.check import Flag, Level


def only(flags: list[Flag]) -> list[Flag]:
    return [f for f in flags if f.check == "stuck"]


def test_a_repeated_buffer_is_flagged_each_time_and_counted(fake: Any) -> None:
    frames = fake.references() + fake.views(6)
    frames[13] = replace(frames[13], counts=frames[12].counts.copy())
    frames[14] = replace(frames[14], counts=frames[12].counts.copy())
    flags = only(fake.flags(frames))
    assert [(f.frame, f.score, f.level) for f in flags] == [(13, 1, Level.ALARM), (14, 2, Level.ALARM)]
    assert "repeats a buffer" in flags[0].advice


def test_one_changed_pixel_is_another_frame(fake: Any) -> None:
    views = fake.views(2)
    counts = views[0].counts.copy()
    counts[5, 5] += 1
    assert only(fake.flags([views[0], replace(views[1], counts=counts)])) == []


def test_darks_without_noise_are_all_equal_and_say_nothing(fake: Any) -> None:
    darks = [replace(frame, counts=np.full_like(frame.counts, 200)) for frame in fake.darks(3)]
    assert only(fake.flags(darks)) == []


def test_views_of_a_single_value_are_stuck_all_the_same(fake: Any) -> None:
    references = fake.references()
    views = [replace(frame, counts=np.full_like(frame.counts, 5000)) for frame in fake.views(4)]
    assert [(f.frame, f.score) for f in only(fake.flags(references + views))] == [(11, 1), (12, 2), (13, 3)]


def test_frames_of_a_view_without_noise_are_alike_and_views_are_not(fake: Any) -> None:
    """Of a scene without noise with several frames a view; a camera's darks are never of one value."""
    plain = [replace(frame, counts=np.full_like(frame.counts, 200)) for frame in fake.darks(3)]
    flat = fake.flats(1)[0]
    flats = [replace(flat, index=i) for i in range(3)]  # of a beam that is not even
    assert only(fake.flags(plain + flats)) == [] and [f.score for f in only(fake.flags(fake.darks(3) + flats))] == [
        1,
        2,
    ]
    views = fake.views(6)
    of_two = [replace(views[i // 2], index=i) for i in range(6)]
    assert only(fake.flags(plain + of_two)) == []
    assert [f.score for f in only(fake.flags(fake.darks(3) + of_two))] == [1, 1, 1]
    turned = [replace(frame, counts=views[0].counts) for frame in views]  # the stage turns, and the image stays
    assert [f.score for f in only(fake.flags(plain + turned))] == [1, 2, 3, 4, 5]
