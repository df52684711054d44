"""StreamingMethod: what a method offers whose volume can grow while views arrive."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from recon.base.geometry import Geometry
from recon.base.method import Method
from recon.splatting.stream import Clock, StreamingFit


@runtime_checkable
class StreamingMethod(Method, Protocol):
    """A method whose volume can grow while views arrive.

    Attributes:
        steps: planned; a fit of views to come takes none.
        seconds: for the last round, over all views.
    """

    @property
    def steps(self) -> int | None: ...

    @property
    def seconds(self) -> float | None: ...

    def finish_sweeps(self, geometry: Geometry) -> int:
        """Sweeps on voxels after the last round."""
        ...

    def stream(self, template: Geometry, seed: int, now: Clock) -> StreamingFit:
        """A fit of views with the geometry of `template`, whose angles are ignored."""
        ...
