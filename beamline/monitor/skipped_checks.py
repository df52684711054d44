"""Which checks skipped views of a scan, and why: a scan that nothing could check must not count as good."""

from __future__ import annotations

from dataclasses import dataclass

from beamline.monitor.change import SPAN
from beamline.monitor.check import ScanContext


@dataclass(frozen=True)
class SkippedChecks:
    """Counts of views with light so far, and of those that checks skipped.

    Attributes:
        views: their number.
        alone: views that were not compared with earlier ones.
        without_flats, cones, wider: views of a scan without flats, of a cone beam, of a sample wider than the field.
    """

    views: int = 0
    alone: int = 0
    without_flats: int = 0
    cones: int = 0
    wider: int = 0

    def with_frame(self, context: ScanContext) -> SkippedChecks:
        """After the next frame; the checks knew `context` of it."""
        if context.view is None or context.grid is None:
            return self
        return SkippedChecks(
            self.views + 1,
            self.alone + (context.change is None),
            self.without_flats + (not context.grid.flats),
            self.cones + context.cone,
            self.wider + (context.truncated and context.grid.flats),
        )

    def in_words(self) -> tuple[str, ...]:
        """Checks, views and reason, a text each. First views, which have no earlier ones, count only if all do."""
        alone = self.alone if self.alone > min(SPAN, self.views - 1) else 0
        reasons = (
            ("drift of beam, field, opposite, mass", self.without_flats, "no flats"),
            ("gain, motion, floater, ghost, dips of beam", alone, "no four views before them at even steps of angle"),
            ("opposite", self.cones, "cone beam"),
            ("mass", self.wider, "sample wider than the field"),
        )
        return tuple(f"{checks} in {n} of {self.views} views ({why})" for checks, n, why in reasons if n)
