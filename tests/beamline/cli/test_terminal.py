"""A progress bar on a terminal, few plain lines elsewhere; every event is either put into words or not shown."""

import io
from collections.abc import Iterator
from typing import Any

import pytest

from beamline.cli.terminal import Terminal
from beamline.core.event_lines import event_of
from beamline.core.events import FrameStored, Warned
from beamline.core.recon_events import FitReached
from beamline.core.sinks import UserLog, sentence
from tests.beamline.pass_options import UNKNOWN, option

FRAME: dict[str, Any] = {
    "n": 90,
    "of": 360,
    "kind": "projection",
    "frames_per_s": 9.97,
    "mb_per_s": 188.2,
    "eta_s": 3725.4,
    "mean": 1.0,
}


FIT: dict[str, Any] = {
    "stage": "recon", "step": 5, "steps": 0, "seconds": 1.0, "loss": 0.1, "residual": 0.1, "n_gaussians": 2,
    "n_views": 4, "held_out": None, "unit": "", "per_s": None, "eta_s": None,
}  # fmt: skip


class Tty(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for name in ("FORCE_COLOR", "NO_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    yield


def shown(stream: io.StringIO, *events: tuple[str, dict[str, Any]]) -> str:
    with Terminal(stream) as terminal:
        for event, data in events:
            terminal(event_of({"event": event, **data}))
    return stream.getvalue()


def test_without_a_terminal_there_are_plain_lines_and_not_too_many() -> None:
    frames = [("frame", {**FRAME, "n": n}) for n in range(1, 361)]
    text = shown(io.StringIO(), ("state", {"state": "acquiring", "message": "Acquiring"}), *frames)
    assert "\x1b" not in text
    lines = text.splitlines()
    assert lines[0] == "Acquiring"
    assert lines[1].startswith("scan: 1/360")
    assert lines[-1].startswith("scan: 360/360")
    assert len(lines) <= 5


def test_a_terminal_gets_a_bar_that_is_gone_at_the_end() -> None:
    text = shown(Tty(), ("frame", FRAME), ("warning", {"message": "[dark] ring overrun"}))
    assert "10.0 frames/s" in text
    assert "Warning: [dark] ring overrun" in text  # brackets are not markup
    assert "\x1b[2K" in text[text.rindex("frames/s") :]  # the line is erased


@pytest.mark.parametrize("stream", [Tty(), io.StringIO()])
def test_names_in_a_bar_and_in_sentences_are_text(stream: io.StringIO) -> None:
    name = "in/[/b]\x1b[2J\n:boom:\u202e.h5"
    trial = {"stage": "batch", "n": 1, "of": 2, "label": name, "eta_s": None, "per_min": 0.0}
    text = shown(stream, ("progress", trial), ("warning", {"message": name}))
    assert text.count("[/b]\\x1b[2J :boom:\\u202e.h5") >= 2 and "\x1b[2J" not in text


def test_a_question_is_asked_with_the_bar_out_of_the_way() -> None:
    stream = Tty()
    with Terminal(stream) as terminal:
        terminal(FrameStored(**FRAME))

        def put(request: str) -> None:
            assert "\x1b[2K" in stream.getvalue()[stream.getvalue().rindex("frames/s") :]  # the bar's line is erased
            before = stream.getvalue()
            terminal(FitReached(**FIT))
            assert stream.getvalue() == before  # and nothing overwrites the question
            stream.write(f"{request}\n")

        terminal.ask("Open the beam shutter.", put)
        terminal(FrameStored(**{**FRAME, "n": 91}))
    assert "91/360" in stream.getvalue().split("Open the beam shutter.")[1]


SNAPSHOT = {"path": "v.h5", "picture": "p.html", "n_views": 40, "seconds": 1.0, "unlearnt": None}


BLOCK = {
    "n": 9, "kind": "flat", "mode": "static", "first_row": 0, "frames": 7, "missing": [], "lost": 0, "ignored": 0,
    "extra": 0,
}  # fmt: skip
FLAG = {"check": "beam", "level": "alarm", "frame": 7, "score": 1.0, "limit": 0.5, "region": None, "first": None}
RUN = {"folder": "runs/x", "path": "s.h5", "sample": "x", "n_frames": 390, "total_bytes": 18e6, "duration": 44.5}
SCAN = {
    "status": "complete", "n_frames": 3, "bytes": 2e3, "seconds": 1, "path": "s.h5", "missing": [], "flags": {},
    "alarmed_frames": 0, "alarmed_views": 0, "retaken": 0, "reference_faults": [], "recon": None,
}  # fmt: skip
OPTIONS = [
    option("next", 0.82, (0.61, 1.02), 90, 95.2, 0.125, 1.21e9),
    option("again", -0.31, (-0.52, 0.1), 90, 95.2, 0.125, 1.21e9),
    option("offset", None, UNKNOWN, 48, 12345.0, 0.067, 6.4e11), option("enough"),
]  # fmt: skip
CHOSEN = {"number": 3, "n_views": 270, "choice": "again", "reason": "it brings most a second.", "options": OPTIONS}
EVENTS = [
    ("run_started", {**RUN, "remarks": []}, "390 frames, 18 MB"),
    ("state", {"state": "done", "message": "Finished"}, "Finished"),
    ("state", {"state": "waiting", "message": "Waiting"}, "Waiting"),
    (
        "block_started",
        {"n": 10, "kind": "dark", "mode": "static", "first_row": 0, "exposure": 0.05, "period": 0.1},
        "Taking 10 dark frames (static, exposure 0.05 s",
    ),
    ("block_done", BLOCK, None),
    ("block_done", {**BLOCK, "missing": [3, 4], "extra": 1}, "2 missing (3-4), 1 extra, without a trigger"),
    ("frame", FRAME, None),
    ("progress", FIT, None),
    ("flag", {**FLAG, "advice": "The beam is lost."}, "Alarm (beam, frame 7)"),
    ("warning", {"message": "hot"}, "Warning: hot"),
    (
        "recon_started",
        {"file": "s.h5", "method": "r2", "n_views": 26, "axis_col": 81.987, "source": "recon"},
        "r2 starts: 26 projections, rotation axis at column 81.99",
    ),
    (
        "recon_started",
        {"file": "s.h5", "method": "r2", "n_views": 40, "axis_col": 82.5, "again": True},
        "r2 starts again from the beginning: 40 projections, rotation axis at column 82.50",
    ),
    ("snapshot", SNAPSHOT, "Volume from the first 40 projections: v.h5"),
    (
        "scan_done",
        SCAN,
        "Scan complete: 3",
    ),
    (
        "error_law",
        {"number": 1, "n_views": 9, "exponent": 1.0, "exponent_error": 0.1, "noise": 1.0, "offset": 0.1},
        None,
    ),
    (
        "next_chosen",
        {**CHOSEN, "by": "program", "predicted": 0.8, "gained": 0.71, "judged": 2, "passes": 2},
        "After pass 2: again, chosen by the program: it brings most a second. Improvement of the PSNR by an "
        "earlier choice: predicted "
        "+0.80 dB, "
        "measured +0.71 dB",
    ),
    (
        "next_chosen",
        {
            **CHOSEN,
            "by": "operator",
            "reason": "chosen by the operator",
            "gained": 0.4,
            "gained_low": 0.2,
            "gained_high": 0.6,
        },
        "again, chosen by the operator. Improvement of the PSNR by an earlier choice: measured +0.40 dB (0.20 to 0.60)",
    ),
    ("next_chosen", {**CHOSEN, "by": "plan", "predicted": 0.8}, "again, as planned: it brings most a second."),
    ("recon_done", {"output": "recon.h5"}, "Volume: recon.h5"),
    ("failed", {"message": "no beam"}, "Failed: no beam"),
    ("done", {"folder": "runs/x"}, "Done: runs/x"),
]


@pytest.mark.parametrize(("event", "data", "words"), EVENTS)
def test_events_in_words(event: str, data: dict[str, Any], words: str | None) -> None:
    text = sentence(event_of({"event": event, **data}))
    if words is None:
        assert text is None
    else:
        assert text is not None
        assert words in text


TABLE = """\
Pass 3 is done, 270 projections so far. What can be measured next:
  choice gain, dB                dB/min        s     dose      data
> next   +0.82 (0.61 to 1.02)     +0.52       95   12.5 %   1.21 GB
  again  -0.31 (-0.52 to 0.10)    -0.20       95   12.5 %   1.21 GB
  offset not known                    -    12345    6.7 %    640 GB
  enough +0.00                        -        0    0.0 %       0 B
"""
PASS = {"number": 3, "n_views": 270, "options": OPTIONS, "recommended": "next"}


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({}, ""),
        (
            {"wait": 30.0},
            "Answer within 30 s: beamline decide CHOICE, or Enter for next.\n"
            "Without an answer, the scan continues as planned.\n",
        ),
        ({"remark": "No volume yet: \x1b[2J"}, "No volume yet: \\x1b[2J\n"),
    ],
)
@pytest.mark.parametrize("stream", [Tty, io.StringIO])
def test_what_can_be_measured_next_stands_side_by_side(
    stream: type[io.StringIO], more: dict[str, Any], words: str
) -> None:
    text = shown(stream(), ("pass_ended", {**PASS, **more}))
    assert text == TABLE + words
    assert max(map(len, text.splitlines())) <= 80
    log = io.StringIO()
    UserLog(log)(event_of({"event": "pass_ended", "time": 1_795_152_000.5, **PASS, **more}))
    assert log.getvalue().replace("2026-11-20T05:20:00Z  ", "") == text


def test_the_longest_question_fits_80_columns() -> None:
    text = shown(io.StringIO(), ("pass_ended", {**PASS, "recommended": "enough", "wait": 900.0}))
    assert max(map(len, text.splitlines())) <= 80


def test_the_user_log_has_a_line_and_a_time_for_each_sentence() -> None:
    stream = io.StringIO()
    log = UserLog(stream)
    log(Warned("hot", time=1_795_152_000.5))
    log(FrameStored(**FRAME, time=1_795_152_001.0))
    assert stream.getvalue() == "2026-11-20T05:20:00Z  Warning: hot\n"
