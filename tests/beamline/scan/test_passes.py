"""A scan in passes: exactly what is chosen after each pass is measured, and the file records it."""

import os
import signal
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import pytest
from click.testing import CliRunner
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from beamline.cli.main import main
from beamline.core.errors import DataError, ScanStopped
from beamline.core.events import Event
from beamline.core.stop import StopRequest, stop_signals
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import validate
from beamline.plan.passes import Choice, Passes
from beamline.projections.replay import judged_flags
from beamline.projections.usable_views import usable_views
from beamline.scan.control import State
from beamline.scan.resume import NothingMissing, NotJoined, open_for_resume, recover_run
from beamline.scan.run import run_scan
from beamline.scan.supervision import Supervision
from beamline.storage.interrupted import next_step
from beamline.storage.readers.open import open_scan
from beamline.storage.recorded_frames import decisions_in, pass_ends_in
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.writers import layout
from beamline.storage.writers.rows import ending_in
from drivers.base.frame import Frame, FrameKind
from tests.beamline.chosen import Scripted, choosing
from tests.beamline.fakes import FakeInstrument, Faults, assert_true, decode
from tests.beamline.ran import Ran, killed
from tests.slow_cases import others_slow

FIRST, VIEWS = 5, 12  # 3 darks and 2 flats before the views
WIDE = 4  # at two angles on either side
WORDS = ("scan.offset_views=2", "sample.diameter_mm=0.9", "scan.settle_s=0", "scan.period_s=2")
MODES = {
    "fly": (("scan.mode=fly", "scan.angles={scheme: interlaced, views: 12, passes: 4}"), 0, [3, 3, 3, 3]),
    "step": (("scan.mode=step", "scan.pass_views=5"), 5, [5, 5, 2]),
    "one": (("scan.mode=step",), 0, [12]),
}


def expected(sizes: Sequence[int], answers: Sequence[Choice]) -> list[list[int]]:
    """Triggers of each set that is chosen, offset views from VIEWS on; without retakes."""
    firsts = [sum(sizes[:i]) for i in range(len(sizes))]
    to_come = [list(range(first, first + n)) for first, n in zip(firsts, sizes, strict=True)]
    done, wide = [to_come.pop(0)], list(range(VIEWS, VIEWS + WIDE))
    sets = [done[0]]
    for answer in answers:
        match answer:
            case Choice.NEXT if to_come:
                done.append(to_come.pop(0))
                sets.append(done[-1])
            case Choice.AGAIN:
                to_come.pop()
                done.append(done[-1])
                sets.append(done[-1])
            case Choice.OFFSET:
                sets.append(wide)
                wide = []
            case Choice.ENOUGH:
                break
    return [*sets, wide]  # what nobody chose


def frames_of(path: Path) -> list[Frame]:
    with open_scan(path) as source:
        return list(source.frames())


@pytest.mark.parametrize("mode", others_slow(MODES))
@settings(max_examples=2, deadline=None)
@given(script=st.lists(st.sampled_from([Choice.NEXT, Choice.NEXT, Choice.AGAIN, Choice.OFFSET, Choice.ENOUGH])))
@example(script=[Choice.AGAIN, Choice.OFFSET, Choice.ENOUGH])
def test_each_choice_is_taken_in_its_place(mode: str, script: list[Choice]) -> None:
    words, pass_views, sizes = MODES[mode]
    chooser = Scripted(script)
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch, choosing(patch, chooser, pass_views):
        ran = Ran(Path(folder), FakeInstrument(), *WORDS, *words)
        ran.assert_safe()
        sets = expected(sizes, chooser.answers)
        frames = frames_of(ran.folder / "scan.h5")
        views = [frame for frame in frames if frame.kind in (FrameKind.PROJECTION, FrameKind.OFFSET_VIEW)]
        assert [frame.trigger for frame in views] == [trigger for triggers in sets for trigger in triggers]
        assert all((frame.trigger >= VIEWS) is (frame.kind is FrameKind.OFFSET_VIEW) for frame in views)
        assert len(views) <= VIEWS + WIDE and all(frame.replaces < 0 for frame in frames)
        assert_true(frame for frame in frames if frame.kind is not FrameKind.OFFSET_VIEW)
        assert [decode(frame.counts)[3] for frame in frames] == list(range(len(frames)))
        enough = Choice.ENOUGH in chooser.answers
        assert len(frames) == FIRST + len(views) + 2  # flats of the end
        assert ran.error is None
        assert (ran.result.missing, ran.result.n_frames, ran.result.retaken) == ((), len(frames), 0)
        if not enough:
            last = ran.of("frame")[-1].data
            assert len(views) < VIEWS + WIDE or last["n"] == last["of"] == len(frames)
        assert sum(event.data["n"] for event in ran.of("block_started")) == len(frames)
        with h5py.File(ran.folder / "scan.h5") as file:
            ended = sets if len(chooser.answers) >= len(sets) else sets[: len(chooser.answers) + 1]
            rows = [FIRST + sum(map(len, sets[: i + 1])) for i in range(len(ended))]
            assert pass_ends_in(file).tolist() == rows[: len(pass_ends_in(file))]
            decisions = decisions_in(file)
            assert [values["choice"] for values in decisions] == chooser.answers
            assert len(pass_ends_in(file)) in (len(decisions), len(decisions) + 1)
            assert file[layout.STATUS][()].decode() == "complete"
        assert next_step(ran.folder / "scan.h5") == ""  # it has what it was to take
        so_far = [passes.n_frames for passes in chooser.asked]
        assert so_far == [values["n_views"] for values in decisions]


def test_the_passes_of_a_step_scan_change_no_plan_so_that_older_parts_of_a_run_have_the_same(tmp_path: Path) -> None:
    ran = Ran(tmp_path, FakeInstrument(), *MODES["step"][0])
    with open_scan(ran.result.path) as source:
        assert "pass_views" not in source.plan
    with h5py.File(ran.result.path) as file:
        assert (pass_ends_in(file).size, decisions_in(file)) == (0, ())


@pytest.mark.parametrize("mode", others_slow(["fly", "step"]))
def test_views_are_taken_again_between_passes_within_the_budget(
    mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A view is lost and one flagged in the first pass, and a third is flagged later, which is taken after the last."""
    words, pass_views, sizes = MODES[mode]
    n = sizes[0]
    lost, flagged = FIRST + 1, {FIRST + 2, FIRST + n + 3 + 1}
    chooser = Scripted([Choice.RETAKE, Choice.RETAKE, Choice.NEXT])
    retake = ("monitor.retake=true", "monitor.retake_share=0.25")
    with choosing(monkeypatch, chooser, pass_views):
        ran = Ran(tmp_path, FakeInstrument(Faults(lost={lost}, repeats=flagged)), *WORDS, *retake, *words)
    assert chooser.answers[:2] == [Choice.RETAKE, Choice.NEXT]  # each view is taken again once
    assert [passes.retakes for passes in chooser.asked][:2] == [2, 0]
    frames = frames_of(ran.result.path)
    again = [frame for frame in frames if frame.trigger >= VIEWS and frame.kind is FrameKind.PROJECTION]
    assert (ran.result.missing, ran.result.retaken, len(again)) == ((), 3, 2)
    assert [frame.index for frame in frames if frame.trigger == 1 and frame.kind is FrameKind.PROJECTION] == [
        FIRST + n - 1
    ]
    assert again[0].index == FIRST + n and again[0].replaces == FIRST + 1
    assert len({frame.trigger for frame in again}) == 2


def test_a_view_without_a_frame_has_one_when_its_pass_is_taken_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words, _, sizes = MODES["fly"]
    faults = Faults(lost={FIRST + 1, FIRST + sizes[0] + 2})  # another one when it is taken again
    with choosing(monkeypatch, Scripted([Choice.AGAIN])):
        ran = Ran(tmp_path, FakeInstrument(faults), *WORDS, *words)
    assert (ran.result.missing, ran.result.retaken) == ((), 1)
    triggers = [frame.trigger for frame in frames_of(ran.result.path) if frame.kind is FrameKind.PROJECTION]
    assert triggers == [0, 2, 0, 1, *range(3, 9)]


def test_the_camera_counts_anew_in_each_pass_also_where_its_first_frame_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("scan.mode=fly", "scan.angles={scheme: interlaced, views: 12, passes: 6}")
    with choosing(monkeypatch, Scripted([])):
        ran = Ran(tmp_path, FakeInstrument(Faults(lost={FIRST + 2})), *WORDS[2:], *words)
    errors = [one.message for one in validate(ran.folder / "scan.h5") if one.severity == "error"]
    assert errors == []  # views 1 and 3, of two passes, both are the second frame of their camera's count


def test_a_stop_while_it_is_asked_ends_the_scan_and_a_closed_shutter_opens_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    instrument, stop = FakeInstrument(), StopRequest()
    answers = iter([Choice.NEXT, Choice.OFFSET, Choice.NEXT])

    def close_and_choose(passes: object) -> Choice:
        instrument.devices.shutter.close()
        if (answer := next(answers, None)) is None:
            stop.stop()
        return answer or Choice.NEXT

    with choosing(monkeypatch, close_and_choose):
        ran = Ran(tmp_path, instrument, *WORDS, *MODES["fly"][0], stop=stop)
    assert "Stopped after 9 of 12 projections: the operator asked" in str(ran.error)
    assert_true(frame for frame in frames_of(ran.folder / "scan.h5") if frame.kind is not FrameKind.OFFSET_VIEW)
    ran.assert_safe()


def test_a_stop_in_the_wide_views_of_one_place_does_not_move_the_sample_to_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = StopRequest()
    with choosing(monkeypatch, Scripted([Choice.OFFSET])):
        ran = Ran(tmp_path, FakeInstrument(at={FIRST + 3: stop.stop}), *WORDS, *MODES["fly"][0], stop=stop)
    wide = [frame.trigger for frame in frames_of(ran.folder / "scan.h5") if frame.kind is FrameKind.OFFSET_VIEW]
    assert wide == [VIEWS]


@pytest.mark.parametrize("mode", others_slow(["fly", "step"]))
def test_the_wide_views_after_enough_pause_and_end_as_those_of_any_scan(
    mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pause waits with a closed shutter. The first Ctrl-C is a stop, which is the reason and ends them at once."""
    words, pass_views, sizes = MODES[mode]
    first, seen = FIRST + sizes[0], list[bool]()

    def resume(event: Event) -> None:
        if event.data.get("state") == State.PAUSED:
            seen.append(instrument.is_open)
            supervisions[-1].pause.resume()

    supervisions, instrument = list[Supervision](), FakeInstrument(at={first: lambda: supervisions[-1].pause.pause()})

    def supervised(*given: Any, **more: Any) -> Supervision:
        supervisions.append(Supervision(*given, **more))
        return supervisions[-1]

    monkeypatch.setattr("tests.beamline.chosen.Supervision", supervised)
    with choosing(monkeypatch, Scripted([Choice.ENOUGH]), pass_views):
        ran = Ran(tmp_path / "paused", instrument, *WORDS, *words, heard=resume)
    assert ran.error is None and seen == [False]
    triggers = [frame.trigger for frame in frames_of(ran.result.path)[FIRST:]]
    assert triggers == [*range(sizes[0]), *range(VIEWS, VIEWS + WIDE), 0, 1]
    stop = StopRequest()
    with choosing(monkeypatch, Scripted([Choice.ENOUGH]), pass_views), stop_signals(stop):
        at = {first: lambda: signal.raise_signal(signal.SIGINT)}
        ran = Ran(tmp_path / "stopped", FakeInstrument(at=at), *WORDS, *words, stop=stop)
    assert not stop.aborting and f"Stopped after {sizes[0]} of 12 projections: Ctrl-C was pressed." in str(ran.error)
    assert [frame.trigger for frame in frames_of(ran.folder / "scan.h5")[FIRST + sizes[0] :]] == [VIEWS]
    with open_for_resume(ran.folder) as series:
        assert series.in_words.endswith(
            "planned; the offset projections and flats that are missing at the end of the run are taken now"
        )
    assert "--resume" in next_step(ran.folder / "scan.h5")


CHOICES = st.lists(st.sampled_from([Choice.NEXT, Choice.AGAIN, Choice.OFFSET, Choice.ENOUGH]), max_size=4)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["fly", pytest.param("step", marks=pytest.mark.long)])
@settings(max_examples=3, deadline=None, phases=[Phase.generate])
@given(script=CHOICES, cuts=st.lists(st.integers(FIRST, FIRST + VIEWS + WIDE - 1), min_size=1, max_size=2))
def test_any_scan_that_is_killed_goes_on(mode: str, script: list[Choice], cuts: list[int]) -> None:
    test_a_scan_that_is_killed_goes_on_within_what_was_chosen(mode, script, cuts)


@pytest.mark.parametrize(
    ("mode", "script", "cuts"),
    others_slow(
        [
            ("fly", [Choice.ENOUGH], [FIRST + 6]),  # in the offset views
            ("step", [Choice.AGAIN, Choice.OFFSET], [FIRST + 7, FIRST + 2]),
        ]
    ),
)
def test_a_scan_that_is_killed_goes_on_within_what_was_chosen(mode: str, script: list[Choice], cuts: list[int]) -> None:
    words, pass_views, sizes = MODES[mode]
    chooser = Scripted(script)
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch, choosing(patch, chooser, pass_views):
        for part, cut in enumerate([*cuts, None]):
            stop, instrument = StopRequest(), FakeInstrument()
            instrument.clock.sleep(1e4 * part)
            instrument.at = {} if cut is None else {cut: stop.abort}
            with killed(patch) if cut is not None else nullcontext():
                if not part:
                    ran = Ran(Path(folder), instrument, *WORDS, *words, stop=stop)
                    continue
                with suppress(ScanStopped, NothingMissing, NotJoined), open_for_resume(ran.folder) as series:
                    run_scan(series.config, series, stop=stop, instrument=instrument.connected())
        recover_run(ran.folder)
        with pytest.raises(NothingMissing), open_for_resume(ran.folder):
            ...
        sets = expected(sizes, chooser.answers)
        path = ran.folder / ("joined.h5" if (ran.folder / "joined.h5").exists() else "scan.h5")
        frames = frames_of(path)
        rows = [frame for frame in frames if frame.kind in (FrameKind.PROJECTION, FrameKind.OFFSET_VIEW)]
        assert [frame.trigger for frame in rows] == [trigger for triggers in sets for trigger in triggers]
        assert_true(frame for frame in frames if frame.kind is not FrameKind.OFFSET_VIEW)
        with h5py.File(path) as file:
            ends, decisions = pass_ends_in(file), decisions_in(file)
            assert ending_in(file).missing == ()
        assert next_step(path) == ""
        assert [values["choice"] for values in decisions] == chooser.answers
        so_far = [sum(frame.index < end for frame in rows) for end in ends]
        assert so_far == [sum(map(len, sets[: i + 1])) for i in range(len(ends))]
        assert len(ends) in (len(decisions), len(decisions) + 1)
        assert [finding for finding in validate(path, lambda done, of: None) if finding.severity == "error"] == []


@pytest.mark.slow
def test_wide_views_that_are_missing_are_taken_also_where_no_references_follow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop, instrument, words = StopRequest(), FakeInstrument(), ("scan.flats.at=start", "scan.darks.at=start")
    with killed(monkeypatch):
        ran = Ran(tmp_path, FakeInstrument(at={FIRST + VIEWS + 1: stop.abort}), *WORDS, *words, stop=stop)
    instrument.clock.sleep(1e4)
    with open_for_resume(ran.folder) as series:
        assert series.in_words.endswith(
            "has all 12 projections; the offset projections that are missing at the end of the run are taken now"
        )
        run_scan(series.config, series, instrument=instrument.connected())
    frames = frames_of(ran.folder / "joined.h5")
    assert [frame.trigger for frame in frames[FIRST:]] == list(range(VIEWS + WIDE))
    with pytest.raises(NothingMissing), open_for_resume(ran.folder):
        ...


@pytest.mark.parametrize(
    ("script", "cut", "missing", "words"),
    others_slow(
        [
            (
                [Choice.ENOUGH],
                FIRST + 3,
                0,
                "with 3 of 12 projections; the scan itself had decided to omit the other projections.",
            ),  # in last flats
            ([Choice.AGAIN], FIRST + 9, 2, "with 10 of 12 projections."),  # another pass of three was to be taken
            (
                [Choice.AGAIN],
                FIRST + 4,
                7,
                "with 5 of 12 projections.",
            ),  # the first pass lacks a view of its second time
        ],
        2,
    ),
)
def test_views_that_the_scan_decided_against_are_not_missing(
    script: list[Choice], cut: int, missing: int, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither of the file whose writer died, nor of the one that joins the parts."""
    stop = StopRequest()
    with choosing(monkeypatch, Scripted(script)), killed(monkeypatch):
        ran = Ran(tmp_path, FakeInstrument(at={cut: stop.abort}), *WORDS[1:], *MODES["fly"][0], stop=stop)
    (recovered,), _ = recover_run(ran.folder)
    assert recovered.missing == missing
    (unfinished,) = [one.message for one in validate(ran.folder / "scan.h5") if one.rule == "unfinished"]
    assert words in unfinished and ("--resume" in unfinished) is (missing > 0)
    stop, instrument = StopRequest(), FakeInstrument()
    instrument.clock.sleep(1e4)
    instrument.at = {FIRST: stop.stop}
    resumed, chooser = open_for_resume(ran.folder), Scripted([])
    with choosing(monkeypatch, chooser), killed(monkeypatch), resumed as series, suppress(ScanStopped, DataError):
        assert (
            f": {missing} of the projections" in series.in_words
            or "has all the projections that were" in series.in_words
        )
        run_scan(series.config, series, stop=stop, instrument=instrument.connected())
    _, part, joined = recover_run(ran.folder)[0]
    assert (part.changed, part.missing, joined.missing) == (True, None, max(0, missing - 1))


def test_a_scan_that_died_is_recovered_also_where_a_choice_is_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = StopRequest()
    with choosing(monkeypatch, Scripted([Choice.NEXT])), killed(monkeypatch):
        ran = Ran(tmp_path, FakeInstrument(at={FIRST + 4: stop.abort}), *WORDS[2:], *MODES["fly"][0], stop=stop)
    file = ran.folder / "scan.h5"
    content, times = file.read_bytes(), file.stat()
    file.write_bytes(content.replace(b'"choice": "next"', b'"choice": "nixt"'))
    os.utime(file, (times.st_atime, times.st_mtime))
    ((recovered,), _), saved = recover_run(ran.folder), frames_of(file)
    assert (recovered.changed, recovered.missing) == (True, None) and recovered.frames == len(saved) > FIRST + 3
    with pytest.raises(DataError, match="nixt"), open_for_resume(ran.folder):
        ...


def stopped(stop: StopRequest, passes: Passes) -> None:
    """No choice: the scan is stopped instead."""
    stop.stop()


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["fly", "step"])
def test_a_choice_that_was_due_when_the_scan_ended_is_made_before_the_next_pass(
    mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words, pass_views, sizes = MODES[mode]
    for folder, ending in (("stopped", nullcontext()), ("died", killed(monkeypatch))):
        stop = StopRequest()
        with choosing(monkeypatch, partial(stopped, stop), pass_views), ending:
            ran = Ran(tmp_path / folder, FakeInstrument(), *WORDS, *words, stop=stop)
        instrument = FakeInstrument()
        instrument.clock.sleep(1e4)
        again = Scripted([Choice.NEXT, Choice.ENOUGH])
        with choosing(monkeypatch, again, pass_views), open_for_resume(ran.folder) as series:
            assert series.in_words.endswith(f"has {sizes[0]} of 12 projections; {12 - sizes[0]} are taken now")
            run_scan(series.config, series, instrument=instrument.connected())
        assert [(len(passes.done), len(passes.to_come)) for passes in again.asked] == [
            (1, len(sizes) - 1),
            (2, len(sizes) - 2),
        ]
        with open_scan(ran.folder / "joined.h5") as source:
            assert [values["number"] for values in source.decisions] == [1, 2]
            views = [frame.index for frame in source.frames() if frame.kind is FrameKind.PROJECTION]
            assert [sum(row < end for row in views) for end in source.table.pass_ends] == [sizes[0], sum(sizes[:2])]
        with pytest.raises(NothingMissing), open_for_resume(ran.folder):
            ...


@pytest.mark.slow
def test_a_file_with_passes_taken_again_is_read_without_a_false_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By validate, by a copy, by the monitor over the file, and by a reconstruction."""
    words = ("scan.mode=fly", "scan.angles={scheme: interlaced, views: 32, passes: 4}", "scan.period_s=0.4")
    wide = ("scan.offset_views=2", "sample.diameter_mm=0.9")
    chooser = Scripted([Choice.AGAIN, Choice.OFFSET])
    with choosing(monkeypatch, chooser):
        ran = Ran(tmp_path / "runs", FakeInstrument(), *words, *wide)
    path = ran.result.path
    assert chooser.answers == [Choice.AGAIN, Choice.OFFSET, Choice.NEXT, Choice.NEXT]
    assert ran.result.flags == {}
    ingest(path, tmp_path / "copy.h5")
    for file in (path, tmp_path / "copy.h5"):
        assert [finding.message for finding in validate(file) if finding.severity != "info"] == []
        with open_scan(file) as source:
            assert source.table.pass_ends.tolist() == [13, 21, 25, 33, 41]
            assert [values["choice"] for values in source.decisions] == chooser.answers
            assert usable_views(ScanEvidence(source), use_flags=True).frames.size == 32
            assert judged_flags(source).flagged.sum() == 0
    out = tmp_path / "volume.h5"
    made = CliRunner().invoke(main, ["recon", str(path), "-m", "fbp", "--axis", "5.5", "-o", str(out), "--no-report"])
    assert made.exit_code == 0, made.output
    assert [line for line in made.output.splitlines() if "arning" in line or "again" in line] == []
