"""Answers to requests of the viewer: slices of one or two volumes or of a scan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, replace
from typing import TYPE_CHECKING, Protocol, TypeVar

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from beamline.core.errors import DataError
from beamline.page.tiles import bin_mean, number_of, numbers_of, region_of, tile_of
from beamline.page.volume import ShownVolume, VolumeTile
from recon.base.greys import grey_windows

if TYPE_CHECKING:
    from beamline.page.shown_scan import ShownScan

_Result = TypeVar("_Result")


class OnVolumes(Protocol):
    """Function that calls a given function with the volumes, in the single thread that reads them, and returns the
    result."""

    def __call__(self, read: Callable[[Sequence[ShownVolume]], _Result]) -> _Result: ...


def viewer_routes(do: OnVolumes) -> list[Route]:
    """Routes of the page of one volume, or of two volumes to compare."""
    server = _Viewer(do)
    return [
        Route("/api/volumes", server.facts),
        Route("/api/slice/{which:number}/{axis:number}/{index:number}", server.cut),
        Route("/api/difference/{axis:number}/{index:number}", server.difference),
        Route("/api/histogram/{which:number}", server.histogram),
        Route("/api/profile/{which:number}/{axis:number}/{index:number}", server.profile),
    ]


def scan_routes(do: OnVolumes, scan: ShownScan) -> list[Route]:
    """Routes of the page of a scan, in addition to those for the slices of its projections."""
    server = _Scan(do, scan)
    return [
        Route("/api/scan", server.facts),
        Route("/api/mean/{kind}", server.mean),
        Route("/api/axis/{row:number}", server.axis),
        Route("/api/fbp/{row:number}", server.fbp),
    ]


def reader_of(volumes: Sequence[ShownVolume]) -> OnVolumes:
    """A thread that reads these volumes before they are requested."""
    thread = ThreadPoolExecutor(1, thread_name_prefix="viewer")

    def read_more() -> None:
        """Read one more slice of a volume that is not read completely. Requests that arrive in the meantime are
        answered before the next slice is read."""
        if any(volume.read_more() for volume in volumes):
            thread.submit(read_more)

    thread.submit(read_more)
    return lambda read: thread.submit(lambda: read(volumes)).result()


def tile_of_volume(tile: VolumeTile) -> Response:
    """A tile of a slice. If `ready` is below 1, the volume is still being read, and a later tile will be better."""
    return tile_of(tile.values, {"region": astuple(tile.region), "bin": tile.bin, "ready": tile.ready})


class _Viewer:
    def __init__(self, do: OnVolumes) -> None:
        self._do = do

    def facts(self, request: Request) -> Response:
        return JSONResponse(self._do(lambda volumes: [volume.facts() for volume in volumes]))

    def cut(self, request: Request) -> Response:
        axis, index, time = _place(request)
        return tile_of_volume(self._on(request, lambda volume: volume.cut(axis, index, region_of(request), time)))

    def difference(self, request: Request) -> Response:
        """The second volume minus the first one; DataError unless both have the same shape."""
        (axis, index, time), region = _place(request), region_of(request)

        def cuts(volumes: Sequence[ShownVolume]) -> list[VolumeTile]:
            if len({volume.shape for volume in volumes}) != 1 or len(volumes) != 2:
                raise DataError("A difference needs two volumes of the same shape.")
            return [volume.cut(axis, index, region, time) for volume in volumes]

        first, second = self._do(cuts)
        if first.values.shape != second.values.shape:  # one of the volumes has several resolutions
            raise DataError(
                "The slices of the two volumes have different resolutions here, so no difference can be shown: zoom in."
            )
        return tile_of_volume(replace(first, values=second.values - first.values, ready=min(first.ready, second.ready)))

    def histogram(self, request: Request) -> Response:
        return JSONResponse(self._on(request, lambda volume: volume.histogram(number_of(request, "time"))))

    def profile(self, request: Request) -> Response:
        axis, index, time = _place(request)
        line = numbers_of(request, "line", 4, "first row, first column, last row, last column")
        return JSONResponse(self._on(request, lambda volume: volume.profile(axis, index, line, time)))

    def _on(self, request: Request, read: Callable[[ShownVolume], _Result]) -> _Result:
        which = int(request.path_params["which"])

        def read_it(volumes: Sequence[ShownVolume]) -> _Result:
            if which >= len(volumes):
                raise DataError(f"This page does not show volume {which}.")
            return read(volumes[which])

        return self._do(read_it)


class _Scan:
    def __init__(self, do: OnVolumes, scan: ShownScan) -> None:
        self._do, self._scan = do, scan

    def facts(self, request: Request) -> Response:
        return JSONResponse(self._do(lambda _: self._scan.facts()))

    def mean(self, request: Request) -> Response:
        """A mean frame, binned to a tile."""
        mean = self._do(lambda _: self._scan.mean(request.path_params["kind"]))
        region = region_of(request).inside((mean.shape[0], mean.shape[1]))
        factor = region.binning()
        return tile_of(bin_mean(mean[region.slices], (factor, factor)), {"region": astuple(region), "bin": factor})

    def axis(self, request: Request) -> Response:
        return JSONResponse(self._do(lambda _: self._scan.axis(int(request.path_params["row"]))))

    def fbp(self, request: Request) -> Response:
        """A slice computed with FBP, with a given axis and tilt. `fast` is True while the user moves a slider."""
        row, (axis, tilt) = int(request.path_params["row"]), numbers_of(request, "axis", 2, "column, degrees of tilt")
        region, fast = region_of(request), number_of(request, "fast") > 0
        tile = self._do(lambda _: self._scan.fbp(row, axis, tilt, region, fast=fast))
        head = {"region": astuple(tile.region), "bin": tile.bin, "windows": grey_windows(tile.values)}
        return tile_of(tile.values, head)


def _place(request: Request) -> tuple[int, int, int]:
    """Axis and index of a slice, and the number of its time (0 if there is only one)."""
    return int(request.path_params["axis"]), int(request.path_params["index"]), number_of(request, "time")
