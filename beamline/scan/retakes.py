"""Retakes: which projections of a scan are taken again, because they were flagged or gave no frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from beamline.core.events import Sink, Warned
from beamline.core.stop import StopRequest
from beamline.core.text import count
from beamline.plan.plan import Retake, Timeline, spread_retakes
from beamline.scan.control import State, StateMachine
from beamline.scan.decider import Decider
from beamline.scan.recorder import Recorder


@dataclass(frozen=True, eq=False)
class Retakes:
    """The projections that may be taken again, as many as the plan allows.

    Attributes:
        recorder: knows which frames were flagged, and gets the number of frames that are taken again.
        decider: knows how many projections were taken again in earlier runs.
    """

    timeline: Timeline
    recorder: Recorder
    decider: Decider
    states: StateMachine
    stop: StopRequest
    sink: Sink

    def begin(self, missing: Sequence[int]) -> Sequence[Retake]:
        """Projections that are taken again now. Their number is announced to the recorder.

        Args:
            missing: triggers that gave no frame.
        """
        chosen, n_bad = self._choose(missing)
        if not chosen:
            return ()
        if len(chosen) < n_bad:
            n_left = n_bad - len(chosen)
            self.sink(
                Warned(
                    f"{n_bad} projections were flagged or gave no frame, but only {len(chosen)} may be taken again "
                    f"(monitor.retake_share). The other {n_left} projections remain as they are."
                )
            )
        seconds = self.timeline.retake_seconds * len(chosen) / self.timeline.plan.retakes
        self.recorder.expect_more(len(chosen), seconds)
        self.states.enter(State.ACQUIRING, f"Taking {count(len(chosen), 'projection')} again")
        return chosen

    def n_possible(self, missing: Sequence[int]) -> int:
        """Number of projections that `begin` would return."""
        return len(self._choose(missing)[0])

    def _choose(self, missing: Sequence[int]) -> tuple[Sequence[Retake], int]:
        """Projections that may be taken again now, and the number of those that were flagged or gave no frame. If there
        are more than the plan allows, an evenly spread part of them.
        """
        plan = self.timeline.plan
        allowed = plan.retakes - self.recorder.announced - self.decider.retaken
        if allowed <= 0:
            return (), 0
        self.recorder.wait()
        flagged = self.recorder.flagged.views_to_retake
        # the others were already taken again
        not_yet_repeated = [view for view in flagged if view.trigger < plan.angles.size]
        candidates = sorted(
            [*not_yet_repeated, *(Retake(-1, trigger) for trigger in missing)], key=lambda view: view.trigger
        )
        return ((), 0) if self.stop.stopping else (spread_retakes(candidates, allowed), len(candidates))
