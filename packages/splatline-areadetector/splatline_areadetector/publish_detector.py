"""PublishedDetector: the scan's camera (cam1:) and a file plugin (HDF1:), as clients see them.

Neither starts, stops or changes the scan. `Acquire` counts the frames of the scan that come from then on, and `Capture`
writes these frames into a file for the client.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np

from beamline.core.errors import BeamlineError, DataError, user_message
from splatline_areadetector.publish_file import XML, FrameFile
from splatline_areadetector.publish_frames import PublishedFrame

Value = float | int | str
_TYPES = ("Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Float32", "Float64")
_COLOURS = ("Mono", "Bayer", "RGB1", "RGB2", "RGB3", "YUV444", "YUV422", "YUV421")
_STATES = (
    "Idle", "Acquire", "Readout", "Correct", "Saving", "Aborting", "Error", "Waiting", "Initializing", "Disconnected",
    "Aborted",
)  # fmt: skip
_MODES, _CONTINUOUS = ("Single", "Multiple", "Continuous"), 2
_COMPRESSIONS = ("None", "N-bit", "szip", "zlib", "Blosc", "BSLZ4", "LZ4", "JPEG")
_NO_YES, _SWITCH = ("No", "Yes"), ("Disable", "Enable")
_TEMPLATE = re.compile(r"%s%s(_%\d?(\.\d)?d)?\.(h5|hdf5|hdf|nxs)")
_WRITE_OK, _WRITE_ERROR = 0, 1
BUSY = ("cam1:Acquire", "HDF1:Capture")
"""Records that stay set until the work has ended."""


class Sides(IntEnum):
    """The records of a value: NAME to write to, NAME_RBV to read, or both."""

    BOTH = 0
    SETPOINT = 1
    READBACK = 2


@dataclass(frozen=True)
class Record:
    """A value that clients see.

    Attributes:
        name: the part after the prefix, without _RBV.
        labels: labels of a choice; its value is an index.
        fixed: clients may write to it, but that changes nothing, and the readback stays.
        length: length of a long text; 0: a text of 39 characters.
    """

    name: str
    initial: Value = 0
    labels: tuple[str, ...] = ()
    sides: Sides = Sides.BOTH
    fixed: bool = False
    length: int = 0


def _of_arrays(plugin: str, *, is_camera: bool) -> tuple[Record, ...]:
    """Records of NDArrayBase, for camera and plugins."""
    sizes = ("ArraySizeX", "ArraySizeY", "ArraySizeZ", "ArraySize0", "ArraySize1", "ArraySize2", "UniqueId")
    texts = {"PortName": plugin.removesuffix(":"), "ADCoreVersion": "3.14.0", "DriverVersion": "1.0"}
    return (
        *(Record(plugin + name, sides=Sides.READBACK) for name in sizes),
        *(Record(plugin + name, text, sides=Sides.READBACK) for name, text in texts.items()),
        Record(plugin + "ColorMode", 0, _COLOURS, Sides.READBACK),
        Record(plugin + "DataType", _TYPES.index("UInt16"), _TYPES, Sides.READBACK),
        Record(plugin + "ArrayCounter"),
        Record(plugin + "NDAttributesFile", XML if is_camera else "", fixed=True, length=1024),
    )


def _of_plugin(plugin: str) -> tuple[Record, ...]:
    return (
        *_of_arrays(plugin, is_camera=False),
        Record(plugin + "NDArrayPort", "cam1", fixed=True, length=256),
        Record(plugin + "NDArrayAddress", fixed=True),
        Record(plugin + "EnableCallbacks", 1, _SWITCH, fixed=True),
        Record(plugin + "MinCallbackTime", 0.0, fixed=True),
        Record(plugin + "QueueSize", 20, fixed=True),
        Record(plugin + "DroppedArrays", fixed=True),
    )


_CAMERA = (
    *_of_arrays("cam1:", is_camera=True),
    Record("cam1:Acquire", 0, ("Done", "Acquire")),
    Record("cam1:AcquireTime", 0.0, fixed=True),
    Record("cam1:AcquirePeriod", 0.0, fixed=True),
    Record("cam1:NumImages", 1),
    Record("cam1:NumImagesCounter", sides=Sides.READBACK),
    Record("cam1:ImageMode", _CONTINUOUS, _MODES),
    Record("cam1:TriggerMode", 1, ("Internal", "External"), fixed=True),
    Record("cam1:ArrayCallbacks", 1, _SWITCH, fixed=True),
    Record("cam1:DetectorState", 0, _STATES, Sides.READBACK),
    Record("cam1:WaitForPlugins", 0, _NO_YES, Sides.SETPOINT, fixed=True),
    *(Record(f"cam1:{name}", fixed=True) for name in ("MinX", "MinY", "SizeX", "SizeY")),
    *(Record(f"cam1:{name}", 1, fixed=True) for name in ("BinX", "BinY")),
    *(
        Record(f"cam1:{name}", text, sides=Sides.READBACK)
        for name, text in {
            "Manufacturer": "splatline", "Model": "camera of the scan", "SerialNumber": "", "SDKVersion": "",
            "FirmwareVersion": "",
        }.items()
    ),
)  # fmt: skip
_FILE = (
    *_of_plugin("HDF1:"),
    *(Record(f"HDF1:{name}", "", length=256) for name in ("FilePath", "FileName")),
    Record("HDF1:FileTemplate", "%s%s.h5", length=256),
    Record("HDF1:FullFileName", "", sides=Sides.READBACK, length=256),
    Record("HDF1:FilePathExists", 0, _NO_YES, Sides.READBACK),
    Record("HDF1:FileNumber", sides=Sides.BOTH),
    Record("HDF1:AutoIncrement", 0, _NO_YES),
    Record("HDF1:CreateDirectory", sides=Sides.BOTH),
    Record("HDF1:FileWriteMode", 2, ("Single", "Capture", "Stream"), fixed=True),
    Record("HDF1:Compression", 0, _COMPRESSIONS, fixed=True),
    Record("HDF1:NumCapture", 0),
    Record("HDF1:NumCaptured", sides=Sides.READBACK),
    *(Record(f"HDF1:{name}", sides=Sides.SETPOINT, fixed=True) for name in ("ArraySize0", "ArraySize1")),
    Record("HDF1:PositionMode", 0, _NO_YES, fixed=True),
    *(Record(f"HDF1:{name}", 1, _NO_YES, fixed=True) for name in ("SWMRMode", "ChunkSizeAuto", "LazyOpen")),
    Record("HDF1:NumExtraDims", fixed=True),
    Record("HDF1:NumFramesChunks", 1, fixed=True),
    Record("HDF1:XMLFileName", "", fixed=True, length=256),
    Record("HDF1:Capture", 0, ("Done", "Capture")),
    Record("HDF1:FlushNow", 0, ("Done", "Flush"), Sides.SETPOINT),
    Record("HDF1:WriteStatus", _WRITE_OK, ("Write OK", "Write error"), Sides.READBACK),
    Record("HDF1:WriteMessage", "", sides=Sides.READBACK, length=256),
)


def records(image: str) -> tuple[Record, ...]:
    """All records; `image` is the name of the process variable with the frames."""
    return (
        *_CAMERA, *_of_plugin("Pva1:"), Record("Pva1:PvName", image, sides=Sides.READBACK, length=256), *_FILE,
    )  # fmt: skip


class PublishedDetector:
    """Camera and file plugin in the form that clients expect. Calls may come from any thread.

    Args:
        put: function that shows a value in the record of this name, without calling the handler of a setpoint. files:
            folder below which clients may request files; None: no files are written. say: function that prints a
            sentence for the person who runs the server.
    """

    def __init__(self, put: Callable[[str, Value], None], files: Path | None, say: Callable[[str], None]) -> None:
        self._put, self._files, self._say = put, None if files is None else files.resolve(), say
        self._fixed = {record.name for record in (*_CAMERA, *_of_plugin("Pva1:"), *_FILE) if record.fixed}
        self._one_sided = {record.name for record in _FILE if record.sides is Sides.SETPOINT}
        self._set: dict[str, Value] = {record.name: record.initial for record in (*_CAMERA, *_FILE)}
        self._lock = threading.RLock()
        self._acquiring, self._counted, self._counter = False, 0, 0
        self._target: Path | None = None  # while it captures
        self._file: FrameFile | None = None  # after the first frame
        self._shape, self._exposure, self._said = (0, 0), 0.0, set[str]()

    def asked(self, name: str, value: Value) -> None:
        """A client has written to a record."""
        with self._lock:
            if name in self._fixed:
                if name == "cam1:AcquireTime" and self._exposure and not np.isclose(float(value), self._exposure):
                    self._say_once(
                        f"A client asked for an exposure of {value:g} s. The scan keeps its exposure of "
                        f"{self._exposure:g} s."
                    )
                return
            self._set[name] = value
            special = {
                "cam1:Acquire": self._acquire, "HDF1:Capture": self._capture, "HDF1:FlushNow": self._flush,
                "HDF1:FilePath": self._look_at_path, "cam1:ArrayCounter": self._count_from,
            }.get(name)  # fmt: skip
            if special is not None:
                special(value)
            elif name not in self._one_sided:
                self._put(f"{name}_RBV", value)

    def began(self, shape: tuple[int, int], dtype: np.dtype) -> None:
        """A new run has begun, with frames of this shape and type."""
        with self._lock:
            (rows, cols), self._shape = shape, shape
            kind = [name.lower() for name in _TYPES].index(dtype.name)
            for plugin in ("cam1:", "Pva1:", "HDF1:"):
                sizes = {"ArraySizeX": cols, "ArraySizeY": rows, "ArraySize0": cols, "ArraySize1": rows}
                for size, n in sizes.items():
                    self._put(f"{plugin}{size}_RBV", n)
                self._put(f"{plugin}DataType_RBV", kind)
            for name, n in {"SizeX": cols, "SizeY": rows}.items():
                self._put(f"cam1:{name}_RBV", n)

    def take(self, frame: PublishedFrame) -> None:
        """A frame was published."""
        with self._lock:
            if frame.exposure != self._exposure:
                self._exposure = frame.exposure
                self._put("cam1:AcquireTime_RBV", frame.exposure)
            self._counter += 1
            for plugin in ("cam1:", "Pva1:"):
                self._put(f"{plugin}ArrayCounter_RBV", self._counter)
                self._put(f"{plugin}UniqueId_RBV", frame.unique_id)
            if not self._acquiring:
                return
            self._counted += 1
            self._put("cam1:NumImagesCounter_RBV", self._counted)
            if self._target is not None:
                self._write(frame, self._target)
            mode, wanted = int(self._set["cam1:ImageMode"]), int(self._set["cam1:NumImages"])
            if mode != _CONTINUOUS and self._counted >= (wanted if mode else 1):
                self._end_acquiring()

    def close(self) -> None:
        """Close the file of a client."""
        with self._lock:
            self._end_capture()

    def _acquire(self, value: Value) -> None:
        if not value:
            self._end_acquiring()
            return
        self._acquiring, self._counted = True, 0
        self._put("cam1:NumImagesCounter_RBV", 0)
        self._put("cam1:DetectorState_RBV", _STATES.index("Acquire"))
        self._put("cam1:Acquire_RBV", 1)

    def _end_acquiring(self) -> None:
        self._acquiring = False
        self._put("cam1:Acquire", 0)
        self._put("cam1:Acquire_RBV", 0)
        self._put("cam1:DetectorState_RBV", _STATES.index("Idle"))

    def _count_from(self, value: Value) -> None:
        self._counter = int(value)
        self._put("cam1:ArrayCounter_RBV", self._counter)

    def _capture(self, value: Value) -> None:
        self._end_capture()
        if not value:
            return
        try:
            self._target = self._asked_path()
        except (BeamlineError, OSError) as error:
            self._fail(error)
            return
        self._put("HDF1:FullFileName_RBV", str(self._target))
        self._put("HDF1:NumCaptured_RBV", 0)
        self._put("HDF1:WriteStatus_RBV", _WRITE_OK)
        self._put("HDF1:WriteMessage_RBV", "")
        self._put("HDF1:Capture_RBV", 1)

    def _write(self, frame: PublishedFrame, target: Path) -> None:
        try:
            if self._file is None:
                self._file = FrameFile(target, frame.counts.shape, frame.counts.dtype)
            self._file.append(frame)
        except DataError as error:
            self._fail(error)
            return
        self._put("HDF1:NumCaptured_RBV", self._file.frames)
        if 0 < int(self._set["HDF1:NumCapture"]) <= self._file.frames:
            self._end_capture()

    def _end_capture(self) -> None:
        file, self._file, self._target = self._file, None, None
        if file is not None:
            file.close()
        self._put("HDF1:Capture", 0)
        self._put("HDF1:Capture_RBV", 0)

    def _fail(self, error: Exception) -> None:
        self._end_capture()
        self._put("HDF1:WriteStatus_RBV", _WRITE_ERROR)
        self._put("HDF1:WriteMessage_RBV", user_message(error)[:255])
        self._say(f"The file that a client asked for is not written: {user_message(error)}")

    def _flush(self, value: Value) -> None:
        if value and self._file is not None:
            self._file.flush()
        self._put("HDF1:FlushNow", 0)

    def _look_at_path(self, value: Value) -> None:
        text = f"{value}"
        shown = text if not text or text.endswith(("/", "\\")) else text + "/"
        self._set["HDF1:FilePath"] = shown
        if int(self._set["HDF1:CreateDirectory"]) < 0 and self._allowed(Path(shown)):
            Path(shown).mkdir(parents=True, exist_ok=True)
        self._put("HDF1:FilePath_RBV", shown)
        self._put("HDF1:FilePathExists_RBV", int(self._allowed(Path(shown)) and Path(shown).is_dir()))

    def _allowed(self, path: Path) -> bool:
        return self._files is not None and path.is_absolute() and path.resolve().is_relative_to(self._files)

    def _asked_path(self) -> Path:
        """The file named by the client's path, name and template. Raises DataError."""
        folder, name = str(self._set["HDF1:FilePath"]), str(self._set["HDF1:FileName"])
        template = str(self._set["HDF1:FileTemplate"])
        if self._files is None:
            raise DataError(
                f"Start `beamline publish` with --files FOLDER, so that the program may write {folder}{name}; "
                "without --files the program writes no files."
            )
        if not self._allowed(Path(folder)):
            raise DataError(f"{folder} is not below the folder of --files, {self._files}.")
        if not _TEMPLATE.fullmatch(template) or not name or Path(name).name != name:
            raise DataError(f"{name!r} with the template {template!r} does not give a file name; expected %s%s.h5.")
        parts = (folder, name, int(self._set["HDF1:FileNumber"]))
        return Path(template % parts[: template.count("%")])

    def _say_once(self, sentence: str) -> None:
        if sentence not in self._said:
            self._said.add(sentence)
            self._say(sentence)
