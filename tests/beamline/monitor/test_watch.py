"""All checks together: no flags on clean scans, several flags on one frame, means of the latest flats and darks."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest

from beamline.monitor import watch as scan
from beamline.monitor.check import CheckResult, Flag, Level, ScanContext
from beamline.monitor.digest import digest
from beamline.monitor.frames import StuckCheck, TimingCheck
from drivers.base.frame import Frame, FrameKind
from tests.slow_cases import others_slow

CONTEXT = ScanContext(saturation=65535, pixels=100)


def test_a_clean_scan_raises_no_flag(fake: Any) -> None:
    frames = fake.references() + fake.views(120) + fake.flats() + fake.darks()
    assert fake.flags(frames) == []


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_flats_with_an_exposure_of_their_own_are_no_change_of_the_beam(fake: Any, factor: float) -> None:
    def flats() -> list[Frame]:
        return [replace(f, exposure=factor * f.exposure) for f in fake.flats(light=factor)]

    clean = fake.darks() + flats() + fake.views(60) + flats() + fake.darks()
    assert fake.flags(clean) == []
    dimmed = fake.darks() + flats() + fake.views(20) + fake.views(2, first=20, light=0.93) + flats()
    found = fake.flags(dimmed)
    assert [(flag.check, flag.frame) for flag in found] == [("gain", len(clean) + 30)]
    assert found[0].score == pytest.approx(-0.07, abs=0.01)


def test_checks_compare_with_the_mean_of_the_latest_group_of_references(fake: Any) -> None:
    groups = [fake.darks(3), fake.flats(4), fake.views(5), fake.flats(3, light=0.9), fake.darks(2)]
    state = scan.start(CONTEXT)
    for frames in groups:
        for frame in frames:
            state, _ = scan.look(state, frame, digest(frame.counts, 65535, 4))
        kind = frames[0].kind
        if kind is not FrameKind.PROJECTION:
            mean = np.mean([digest(frame.counts, 65535, 4).preview for frame in frames], axis=0)
            found = state.context.dark if kind is FrameKind.DARK else state.context.flat
            np.testing.assert_allclose(np.asarray(found), mean, rtol=1e-5)


@dataclass(frozen=True)
class Early:
    """Says of every projection that the three rows before it had it too."""

    name: ClassVar[str] = "early"

    def start(self) -> None:
        return None

    def look(self, state: None, frame: Frame, digest: Any, context: ScanContext) -> CheckResult[None]:
        return CheckResult(state, Flag(self.name, Level.WARN, frame.index, 1.0, 0.0, "", first=frame.index - 3))


def test_a_finding_reaches_back_to_the_first_of_the_frames_of_its_kind(fake: Any) -> None:
    flags = fake.flags(fake.references() + fake.views(5) + fake.flats(1), checks=[Early()])
    assert [list(flag.frames) for flag in flags[10:]] == [
        [10], [10, 11], [10, 11, 12], [10, 11, 12, 13], [11, 12, 13, 14], [15],
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("dark", "flat", "views"), others_slow([(0.0, 0.0, 0.0), (0.0, 1e3, 1e3), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0)], 2)
)
def test_no_check_fails_on_scans_without_light_or_with_far_too_much(
    fake: Any, dark: float, flat: float, views: float
) -> None:
    frames = fake.darks(light=dark) + fake.flats(light=flat) + fake.views(30, light=views)
    still = [replace(frame, counts=frames[0].counts) for frame in frames]  # the same noise in all
    for scan_of in (frames, still):
        fake.flags(scan_of)


def test_a_check_that_raises_names_itself_and_the_others_go_on(fake: Any) -> None:
    class Broken(StuckCheck):
        def look(self, *_: object) -> Any:
            raise ZeroDivisionError

    frame = fake.darks(1)[0]
    monitor = scan.start(CONTEXT, (Broken(), TimingCheck()))
    with pytest.raises(scan.CheckError, match="the check stuck failed"):
        scan.look(monitor, frame, digest(frame.counts, CONTEXT.saturation, 4))
    after, _ = scan.look(scan.without(monitor, "stuck"), frame, digest(frame.counts, CONTEXT.saturation, 4))
    assert [check.name for check in after.checks] == ["timing"]
