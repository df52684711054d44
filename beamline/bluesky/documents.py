"""Bluesky documents (event-model) of a scan. Its frames stay in this program's file; a stream datum announces new
rows.

Each index is one row of the file; darks and flats have rows, too. A trigger without a frame has no index.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TextIO
from urllib.parse import urlsplit

import click

from beamline.config.load import Config
from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event, Failed, FrameStored, RunDone, RunStarted, ScanDone, Sink, json_of
from beamline.scan.dry_run import dry_run
from beamline.storage.writers import layout

Emit = Callable[[str, Mapping[str, Any]], object]
"""Function that takes a document: its name and its values."""

STREAM = "primary"
REACH = 1.0
"""s within which a 0MQ proxy must answer, and at the end must accept the documents sent to it."""
JOIN = 0.5
"""s until a proxy accepts documents. 0MQ connects in the background, and drops documents that come before."""


class Column(NamedTuple):
    """A dataset of the scan file with a row for each frame. In bluesky it is a data key."""

    dataset: str
    kind: str
    unit: str

    def row_shape(self, frame: tuple[int, int]) -> tuple[int, ...]:
        """Shape of a row, if frames have the shape `frame`."""
        return frame if self.dataset == layout.DATA else ()


COLUMNS = {  # by the end of the name of the data key
    "": Column(layout.DATA, "<u2", "counts"),
    "-angle": Column(layout.ANGLE, "<f8", "degree"),
    "-kind": Column(layout.KIND, "<i4", ""),
}


def event_model() -> Any:
    """The library event-model. Raises ConfigError if it is not installed."""
    try:
        import event_model as library
    except ImportError as error:
        raise ConfigError(
            f'a package for bluesky is missing ({error}): pip install "splatline[bluesky]". Nothing was started.'
        ) from error
    return library


class ScanStream:
    """The data of one scan as a stream: data keys before the scan begins, then resources and datums as the file grows.

    Args:
        name: beginning of the names of the data keys: NAME (the frame), NAME-angle, NAME-kind.
    """

    def __init__(self, config: Config, name: str) -> None:
        self.shape = dry_run(config).camera.shape
        self._name, self._behind = name, config.storage.flush_every - 1
        self._library, self._path = event_model(), Path()
        self._bundles: list[Any] = []
        self._emitted = self.rows = 0

    def data_keys(self) -> dict[str, Any]:
        """The data keys of a descriptor."""
        return {
            self._name + ending: {
                "source": f"splatline:{column.dataset}",
                "shape": list(column.row_shape(self.shape)),
                "dtype": "array" if column.row_shape(self.shape) else "number",
                "dtype_numpy": column.kind,
                "units": column.unit,
                "external": "STREAM:",
            }
            for ending, column in COLUMNS.items()
        }

    def __call__(self, event: Event) -> None:
        """Process an event of the scan, which gives the path of its file, and the number of rows that other programs
        can read."""
        if event.source is not None:  # of the live reconstruction
            return
        if isinstance(event, RunStarted):
            self._path, self._emitted, self.rows, self._bundles = event.path, 0, 0, []
        elif isinstance(event, FrameStored):
            self.rows = max(self.rows, event.n - self._behind)  # the writer flushes at least this often
        elif isinstance(event, ScanDone):
            self.rows = event.result.n_frames

    def assets(self, until: int, run_start: str | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
        """Resources and datums of the rows before `until` that were not emitted yet. `run_start`: uid of the run; None:
        the RunEngine fills it in.
        """
        until = min(until, self.rows)
        if until <= self._emitted:
            return
        if not self._bundles:
            self._bundles = list(self._resources())
            for bundle in self._bundles:
                yield "stream_resource", bundle.stream_resource_doc | ({"run_start": run_start} if run_start else {})
        for bundle in self._bundles:
            yield "stream_datum", bundle.compose_stream_datum(indices={"start": self._emitted, "stop": until})
        self._emitted = until

    def _resources(self) -> Iterator[Any]:
        compose = self._library.ComposeStreamResource()
        for ending, column in COLUMNS.items():
            chunk = (1, *column.row_shape(self.shape))
            parameters = {"dataset": column.dataset, "chunk_shape": chunk, "swmr": True}
            yield compose(
                mimetype="application/x-hdf5",
                uri=file_url(self._path),
                data_key=self._name + ending,
                parameters=parameters,
            )


class Documents:
    """A sink of events that emits the documents of a scan: start, descriptor, resources, datums, stop.

    Raises:
        ConfigError: event-model is not installed.
    """

    def __init__(self, config: Config, emit: Emit, name: str = "camera") -> None:
        self._config, self._emit, self._stream = config, emit, ScanStream(config, name)
        self._run: Any = None
        self._descriptor: Any = None
        self._exit = "success"

    def __call__(self, event: Event) -> None:
        if event.source is not None:  # of the live reconstruction
            return
        self._stream(event)
        if isinstance(event, RunStarted):
            self._begin(event)
        if self._run is None:
            return
        if isinstance(event, FrameStored | ScanDone):
            self._tell_rows()
        if isinstance(event, ScanDone):
            self._exit = {"complete": "success", "stopped": "abort"}.get(event.result.status, "fail")
        elif isinstance(event, RunDone | Failed):
            self._end(event.message if isinstance(event, Failed) else "", failed=isinstance(event, Failed))

    def _begin(self, event: RunStarted) -> None:
        sample, optics = self._config.sample, self._config.optics
        self._run = event_model().compose_run(
            metadata={
                "plan_name": "beamline scan",
                "sample": {"name": sample.name, "description": sample.description},
                "run_folder": str(event.folder.absolute()),
                "num_points": event.n_frames,
                "pixel_size_um": optics.pixel_size_um,
                "energy_kev": optics.energy_kev,
                "detectors": ["camera"],
                "motors": ["stage"],
            }
        )
        self._emit("start", self._run.start_doc)
        self._descriptor = self._run.compose_descriptor(
            name=STREAM, data_keys=self._stream.data_keys(), object_keys={"camera": list(self._stream.data_keys())}
        )
        self._emit("descriptor", self._descriptor.descriptor_doc)

    def _tell_rows(self) -> None:
        for name, document in self._stream.assets(self._stream.rows, self._run.start_doc["uid"]):
            if name == "stream_datum":
                rows = document["indices"]
                document |= {
                    "descriptor": self._descriptor.descriptor_doc["uid"],
                    "seq_nums": {"start": rows["start"] + 1, "stop": rows["stop"] + 1},
                }
            self._emit(name, document)

    def _end(self, reason: str, failed: bool) -> None:
        status = "fail" if failed and self._exit == "success" else self._exit
        stop = self._run.compose_stop(exit_status=status, reason=reason)
        self._emit("stop", stop | {"num_events": {STREAM: self._stream.rows}})
        self._run = None


def file_url(path: Path) -> str:
    """The URL of a file in the form that resources need."""
    return path.absolute().as_uri().replace("file:///", "file://localhost/", 1)


def _write_line(stream: TextIO, name: str, document: Mapping[str, Any]) -> None:
    """Writes a document as one line, as bluesky's own JSONLinesWriter does, and flushes it."""
    stream.write(json_of({"name": name, "doc": document}) + "\n")
    stream.flush()


@contextmanager
def published(address: str, warn: Callable[[str], None]) -> Iterator[Emit]:
    """Sends documents to a 0MQ proxy with bluesky's own Publisher. It never waits: documents without a receiver are
    dropped.

    Args:
        address: tcp://HOST:PORT at which the proxy accepts documents.
        warn: function that gets a sentence if no program listens there.

    Raises: ConfigError: the address has another form, or bluesky or pyzmq is not installed.
    """
    try:
        from bluesky.callbacks.zmq import Publisher
        from zmq import ZMQError  # type: ignore[attr-defined,unused-ignore]
    except ImportError as error:
        raise ConfigError(
            f'a package for 0MQ is missing ({error}): pip install "splatline[bluesky]". Nothing was started.'
        ) from error
    try:
        url = urlsplit(address)
        if url.scheme != "tcp" or not url.hostname or url.port is None:
            raise ValueError(address)
        publisher = Publisher(address)
    except (ValueError, ZMQError) as error:
        raise ConfigError(
            f"{address} is not an address for 0MQ; expected tcp://HOST:PORT. Nothing was started."
        ) from error
    try:
        try:
            socket.create_connection((url.hostname, url.port), REACH).close()
            time.sleep(JOIN)
        except OSError as error:
            warn(f"No program is listening at {address} ({error}): documents are lost until a program listens there.")
        yield publisher
    finally:  # the close of Publisher itself would wait for ever for a proxy that no longer reads
        publisher._context.destroy(linger=round(1000 * REACH))


def sink(config: Config, place: str, held: ExitStack) -> Sink:
    """A sink of events that appends the documents to a file, or sends them to a 0MQ proxy (tcp://HOST:PORT).

    Args:
        held: exit stack that closes file and connection.

    Raises:
        ConfigError: a library is missing, or no proxy answers.
        DataError: the file cannot be written to.
    """
    event_model()  # if event-model is missing, no file is made
    if "://" in place:
        warn = partial(click.echo, err=True)
        return Documents(config, held.enter_context(published(place, warn)))
    path = Path(place)
    try:
        stream = held.enter_context(path.open("a", encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path} cannot be written to ({error.strerror}). Nothing was started.") from error
    return Documents(config, partial(_write_line, stream))
