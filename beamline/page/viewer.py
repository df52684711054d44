"""The viewer's server: one or two volumes as a page, slice by slice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from beamline.core.errors import DataError
from beamline.page.app import Access, guarded, region_of, tile_of
from beamline.page.tiles import TileRegion
from beamline.page.volume import ShownVolume

_Result = TypeVar("_Result")


def viewer(volumes: Sequence[ShownVolume], access: Access) -> Starlette:
    """The application for one volume, or two to compare."""
    server = _Viewer(volumes)
    routes = [
        Route("/api/volumes", server.facts),
        Route("/api/slice/{which:int}/{axis:int}/{index:int}", server.cut),
        Route("/api/difference/{axis:int}/{index:int}", server.difference),
        Route("/api/histogram/{which:int}", server.histogram),
        Route("/api/profile/{which:int}/{axis:int}/{index:int}", server.profile),
    ]
    return guarded("view.html", routes, access)


class _Viewer:
    """Each answer is computed in one thread, as HDF5 asks for."""

    def __init__(self, volumes: Sequence[ShownVolume]) -> None:
        self._volumes, self._thread = volumes, ThreadPoolExecutor(1, thread_name_prefix="viewer")

    def facts(self, request: Request) -> Response:
        return JSONResponse(self._do(lambda: [volume.facts() for volume in self._volumes]))

    def cut(self, request: Request) -> Response:
        volume, axis, index = self._volume(request), *_place(request)
        return _picture(*self._do(lambda: volume.cut(axis, index, region_of(request))))

    def difference(self, request: Request) -> Response:
        """The second volume less the first one; DataError unless both have one shape."""
        if len({volume.shape for volume in self._volumes}) != 1 or len(self._volumes) != 2:
            raise DataError("A difference is of two volumes of the same shape.")
        (axis, index), region = _place(request), region_of(request)
        first, second = self._do(lambda: [volume.cut(axis, index, region) for volume in self._volumes])
        return _picture(second[0] - first[0], *first[1:])

    def histogram(self, request: Request) -> Response:
        return JSONResponse(self._do(self._volume(request).histogram))

    def profile(self, request: Request) -> Response:
        volume, axis, index = self._volume(request), *_place(request)
        try:
            line = [float(word) for word in request.query_params.get("line", "").split(",")]
            if len(line) != 4 or not all(abs(each) < 1e6 for each in line):
                raise ValueError
        except ValueError:
            raise DataError("A profile is along a line: first row, first column, last row, last column.") from None
        return JSONResponse(self._do(lambda: volume.profile(axis, index, line)))

    def _volume(self, request: Request) -> ShownVolume:
        which = int(request.path_params["which"])
        if which >= len(self._volumes):
            raise DataError(f"Volume {which} is not shown here.")
        return self._volumes[which]

    def _do(self, read: Callable[[], _Result]) -> _Result:
        return self._thread.submit(read).result()


def _picture(values: NDArray[np.float32], shown: TileRegion, factor: int) -> Response:
    return tile_of(values, {"region": astuple(shown), "bin": factor})


def _place(request: Request) -> tuple[int, int]:
    return int(request.path_params["axis"]), int(request.path_params["index"])
