"""Output lines: a finding about several frames is printed once with their number; other events as they come."""

from __future__ import annotations

import io

from beamline.core.events import Event, FrameFlagged, FrameStored, Warned
from beamline.core.flag import Flag, Level
from beamline.core.sinks import Narration, UserLog


def crumb(first: int, frame: int, time: float = 0.0, level: Level = Level.WARN) -> FrameFlagged:
    return FrameFlagged(Flag("floater", level, frame, 9.0, 7.0, f"to {frame}", first=first), time=time)


def stored(n: int) -> FrameStored:
    return FrameStored(n, 400, "projection", 10.0, 1.0, 1.0, 100.0, time=0.0)


def flags(events: list[Event]) -> list[tuple[int, int, int]]:
    narrated = Narration()
    told = [(n, each) for n, event in enumerate(events) for each in narrated(event)]
    return [(n, each.flag.frames.start, each.flag.frame) for n, each in told if isinstance(each, FrameFlagged)]


def test_a_crumb_in_twelve_frames_is_one_line_of_the_log() -> None:
    log = io.StringIO()
    write = UserLog(log)
    for frame in range(40, 52):
        write(crumb(38 if frame == 40 else frame, frame))
        write(stored(frame + 2))
    write(Warned("something else", time=0.0))
    write(stored(90))
    lines = [line.partition("Z  ")[2] for line in log.getvalue().splitlines()]
    assert lines == ["Warning: something else", "Warn (floater, 14 frames, 38 to 51): to 51"]


def test_two_crumbs_are_two_lines_and_an_alarm_waits_for_nobody() -> None:
    assert flags([crumb(38, 40), crumb(41, 44), crumb(70, 72), stored(120)]) == [(2, 38, 44), (3, 70, 72)]
    assert flags([crumb(38, 40, level=Level.ALARM), crumb(41, 44, level=Level.ALARM)]) == [(0, 38, 40), (1, 41, 44)]
    one = FrameFlagged(Flag("mass", Level.WARN, 7, 1.0, 0.5, "x"), time=0.0)
    assert flags([one, one]) == [(0, 7, 7), (1, 7, 7)]
