"""Projections that checks could not examine are reported with their number; a complete scan has none."""

from collections.abc import Iterable
from typing import Any

from beamline.monitor import watch
from beamline.monitor.check import ScanContext
from beamline.monitor.digest import digest
from beamline.projections.replay import SkippedChecks
from drivers.base.frame import Frame
from tests.beamline.monitor.conftest import COLS, ROWS


def said(frames: Iterable[Frame], **known: Any) -> tuple[str, ...]:
    monitor, aside = watch.start(ScanContext(65535, ROWS * COLS, **known), ()), SkippedChecks()
    for frame in frames:
        monitor, _ = watch.look(monitor, frame, digest(frame.counts, 65535, 4))
        aside = aside.with_frame(monitor.context)
    return aside.in_words()


def test_a_scan_at_even_steps_with_flats_was_looked_at(fake: Any) -> None:
    assert said(fake.references() + fake.views(10)) == ()


def test_each_reason_is_named_with_its_views(fake: Any) -> None:
    assert said(fake.darks() + fake.views(10)) == (
        "drift of beam, field, opposite, mass in 10 of 10 projections (no flats)",
    )
    assert said(fake.references() + fake.views(10), cone=True) == ("opposite in 10 of 10 projections (cone beam)",)
    wide = ((0.0, 0.0, 60.0, 0.02),)
    (text,) = said(fake.references() + fake.views(10, discs=wide))
    assert text == "mass in 10 of 10 projections (sample wider than the field of view)"


def test_views_at_uneven_angles_and_too_few_of_them_were_not_compared(fake: Any) -> None:
    jumps = [frame for at in (0, 50, 7, 91, 23, 60, 3) for frame in fake.views(1, first=at)]
    (text,) = said(fake.references() + jumps)
    assert text.startswith(
        "gain, motion, floater, ghost, dips of beam in 7 of 7 projections (fewer than four projections"
    )
    assert "in 1 of 1 projections" in said(fake.references() + fake.views(1))[0]
