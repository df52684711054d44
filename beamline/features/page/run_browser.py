"""The page of a folder of runs: a table of them, and the page of each below `/run/NUMBER/`, to look alone."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass, replace
from pathlib import Path

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.types import ASGIApp, Receive, Scope, Send

from beamline.core.errors import DataError
from beamline.core.files import EVENTS, is_link, parts_of
from beamline.features.page.app import Access, begins_with, guarded, page_routes
from beamline.page.run_files import Reader, watched
from beamline.scan.runs import HEAD, Run, cells, describe, runs_in

OPEN_RUNS = 8
"""Runs whose files stay open without anybody who watches."""


@dataclass
class _Opened:
    reader: Reader
    app: ASGIApp
    requests: int = 0  # being answered; the feed of an open page is one


class RunBrowser:
    """The runs of a folder under numbers of its own: no name from a client reaches the file system."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock = folder, threading.Lock()
        self._access = Access(())
        self._numbers: dict[Path, int] = {}
        self._known: dict[Path, tuple[tuple[int, ...], Run]] = {}
        self._opened: dict[int, _Opened] = {}

    def close(self) -> None:
        for opened in self._opened.values():
            opened.reader.close()

    def app(self, access: Access) -> Starlette:
        """The application; its pages of runs are read-only."""
        self._access = replace(access, act=None)
        routes = [Route("/api/runs", self.table), Mount("/run/{number:number}", self.page_of)]
        return guarded("runs.html", routes, access)

    def table(self, request: Request) -> Response:
        """Head and rows, newest first, each with the number of its page."""
        with self._lock:
            rows = [
                {"number": self._numbers.setdefault(run, len(self._numbers)), "cells": cells(self._described(run))}
                for run in runs_in(self._folder)
                if not _by_a_stranger(self._folder, run)
            ]
        return JSONResponse({"folder": self._folder.resolve().name, "head": HEAD, "rows": rows})

    async def page_of(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request as the page of a run does."""
        opened = self._open(scope["path_params"]["number"])
        opened.requests += 1
        try:
            await opened.app(scope, receive, send)
        finally:
            opened.requests -= 1

    def _open(self, number: int) -> _Opened:
        runs = list(self._numbers)  # by number; a copy, since `table` adds to it in another thread
        if number >= len(runs):
            raise DataError(f"There is no run {number} here.")
        if number not in self._opened:
            unused = [n for n, opened in self._opened.items() if not opened.requests]
            for n in unused[: len(self._opened) + 1 - OPEN_RUNS]:
                self._opened.pop(n).reader.close()
            reader = Reader(watched(runs[number]))
            routes = page_routes(reader, self._access, lambda line: None)  # nobody may act from here
            self._opened[number] = _Opened(reader, begins_with("index.html", routes))
        return self._opened[number]

    def _described(self, run: Path) -> Run:
        """Its facts, looked up again when its folder or log has changed."""
        changed = tuple(_changed(path) for part in parts_of(run) for path in (part, part / EVENTS))
        if run not in self._known or self._known[run][0] != changed or not self._known[run][1].over:
            self._known[run] = changed, describe(run)
        return self._known[run][1]


def _by_a_stranger(folder: Path, run: Path) -> bool:
    """Whether another user made a link on the way to a run, which could lead to any run that this program can read."""
    if not hasattr(os, "geteuid"):
        return False
    way = [run, *run.parents]
    links = [place for place in way[: way.index(folder)] if is_link(place)]
    return any(link.lstat().st_uid not in (0, os.geteuid()) for link in links)


def _changed(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0
