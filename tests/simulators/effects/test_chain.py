"""Chain: labels of what a frame sees at several moments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.anomaly import Label
from simulators.effects.catalogue import Domain
from simulators.effects.chain import Chain
from simulators.effects.motion_blur import MotionBlur
from simulators.frame.shot import Image, Shot
from tests.simulators import shots


@dataclass(frozen=True)
class _Wanderer:
    """Two bodies that go opposite ways by as many pixels as the stage has turned tenths of a radian."""

    domain: Domain = Domain.OPTICAL_DEPTH  # type: ignore[misc]

    name: ClassVar[str] = "wanderer"
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        return image

    def labels(self, shot: Shot) -> list[Label]:
        k = round(10 * shot.angle)
        return [Label("wanderer", (10 + k, 12 + k, 20 + k, 22 + k)), Label("wanderer", (30 - k, 33 - k, 40, 41), 1)]


def _labels(domain: Domain, turned: float, **state: bool) -> tuple[Label, ...]:
    shot = shots.shot(angle=0.0, angle_at=lambda time: turned * (time - 1000.0) / 0.01, radius=0.5, **state)
    order = [MotionBlur(0.1, 10), _Wanderer(domain)]
    return Chain.of(order).labels(shot)


def test_what_turns_with_the_sample_is_labelled_wherever_it_is_while_the_frame_looks() -> None:
    # 10 moments of a turn by 2 rad: from 1 to 19 tenths.
    assert _labels(Domain.OPTICAL_DEPTH, 2.0) == (
        Label("wanderer", (11, 31, 21, 41)),
        Label("wanderer", (11, 32, 40, 41), 1),
    )
    assert _labels(Domain.OPTICAL_DEPTH, -2.0) == (
        Label("wanderer", (-9, 11, 1, 21)),
        Label("wanderer", (31, 52, 40, 41), 1),
    )


def test_what_acts_on_the_whole_exposure_is_asked_once() -> None:
    here = (Label("wanderer", (10, 12, 20, 22)), Label("wanderer", (30, 33, 40, 41), 1))
    assert _labels(Domain.PHOTONS, 2.0) == here
    assert _labels(Domain.OPTICAL_DEPTH, 2.0, sample=False) == here


def test_effects_that_are_no_anomalies_have_no_labels() -> None:
    assert Chain.of([MotionBlur()]).labels(shots.shot(angle_at=lambda time: 0.0)) == ()
