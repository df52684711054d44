"""How an NXtomo must be written down (NeXus definitions 2026.01 and what its readers need), one function a rule."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.storage import datasets, hdf5
from beamline.storage.parts import pass_ends_in
from beamline.storage.readers.nexus import Places, find
from beamline.storage.rules import Finding
from beamline.storage.writers import layout

Rule = Callable[[Places], Iterator[Finding]]


def nexus_findings(file: h5py.File) -> list[Finding]:
    """Findings in every tomography entry of a file; [] for a file without one."""
    return [finding for places in find(file) for rule in RULES for finding in _found(rule, places)]


def _found(rule: Rule, places: Places) -> list[Finding]:
    """Findings of one rule; a rule that fails to read the file is an error, too: it is damaged, or altered."""
    try:
        return list(rule(places))
    except hdf5.ALTERED as error:
        return [Finding("error", "layout", f"{rule.__name__}: damaged, or not laid out as it should be ({error}).")]


def definition_stated(places: Places) -> Iterator[Finding]:
    """The entry states that it is an NXtomo, whose data are detector counts (NX_INT)."""
    definition = datasets.text_at(places.entry, "definition") or datasets.attribute(places.entry, "definition")
    if definition == layout.FLOAT_DEFINITION:
        yield Finding("info", "definition", f"{definition}: float frames in NXtomo's places, on purpose not an NXtomo.")
    elif definition != layout.NXTOMO:
        yield Finding("warning", "definition", f"{places.entry.name}/definition is {definition!r}, expected 'NXtomo'.")
    if (
        places.data.id.dtype.kind not in "iu"
        and datasets.text_at(places.entry, "definition") != layout.FLOAT_DEFINITION
    ):
        message = f"Frames are {places.data.dtype}; NXtomo demands integers, as the camera counted."
        yield Finding("error", "integer-frames", message)


def lengths(places: Places) -> Iterator[Finding]:
    """There is one image key and one angle for each frame."""
    for name in ("image_key", "image_key_control"):
        key = datasets.dataset(places.detector, name)
        if key is not None and key.size != places.data.shape[0]:
            yield Finding("error", "key-length", f"{name} has {key.size} entries for {places.data.shape[0]} frames.")
    if places.angle is not None and places.angle.size != places.data.shape[0]:
        yield Finding("error", "angle-length", f"{places.angle.size} angles for {places.data.shape[0]} frames.")


def key_codes(places: Places) -> Iterator[Finding]:
    """Image keys are 0 projection, 1 flat, 2 dark, 3 invalid; -1 (alignment) only in image_key_control."""
    for name, legal in (("image_key", {0, 1, 2, 3}), ("image_key_control", {-1, 0, 1, 2, 3})):
        key = datasets.dataset(places.detector, name)
        wrong = set() if key is None else set(np.unique(datasets.values_of(key)).tolist()) - legal
        if wrong:
            yield Finding("error", "key-codes", f"{name} holds {sorted(wrong)}; legal are {sorted(legal)}.")


def angle_units(places: Places) -> Iterator[Finding]:
    """Angles have a unit: readers differ in their default."""
    if places.angle is not None:
        unit = datasets.attribute(places.angle, "units")
        if datasets.factor_of(unit, datasets.ANGLE_UNITS) is None:
            units = f"the units {unit!r}" if unit else "no units attribute"
            yield Finding("error", "angle-units", f"{places.angle.name} has {units}; expected degree or rad.")


def time_order(places: Places) -> Iterator[Finding]:
    """Frames are in the order of their times."""
    times = _column(places, "frame_log/time")
    back = np.flatnonzero(np.diff(times) < 0)
    if back.size:
        step = times[back[0] + 1] - times[back[0]]
        yield Finding(
            "error", "time-order", f"Time goes back {back.size} times (first: frame {back[0] + 1}, by {-step:.6g} s)."
        )


def framestamp_order(places: Places) -> Iterator[Finding]:
    """The camera's frame counter increases by one for each frame.

    It starts again where the camera was armed anew: with other frames, or for other triggers of the same ones, or with
    another part of a joined file. Not always at 0, for the first frame may be lost.
    """
    stamps, triggers = _column(places, "frame_log/framestamp"), _column(places, "frame_log/trigger")
    key = np.ravel(datasets.values_of(places.image_key))[: stamps.size]
    if stamps.size < 2 or key.size < stamps.size or triggers.size != stamps.size or (stamps < 0).any():
        return
    steps = np.diff(stamps)
    new = np.zeros(triggers.size, np.bool_)
    passes = np.searchsorted(pass_ends_in(places.entry.file), np.arange(key.size), "right")  # one may be repeated
    aside = _column(places, "sample/x_translation")  # wide views count from the last view, as those taken again do
    aside = aside if aside.size == key.size else np.zeros(key.size)
    new[np.unique(np.stack([key, triggers, passes, aside]), axis=1, return_index=True)[1]] = True
    parts = places.data.virtual_sources() if places.data.is_virtual else []
    begin = [part.vspace.get_select_bounds()[0][0] for part in parts]
    new[[row for row in begin if row < new.size]] = True
    armed = (np.diff(passes) > 0) | (new[1:] & ((steps < 0) | (stamps[1:] == 0)))
    same_block = (np.diff(key) == 0) & ~armed
    repeated = np.flatnonzero(same_block & (steps <= 0))
    if repeated.size:
        yield Finding(
            "error",
            "framestamps",
            f"{repeated.size} frames repeat or go back in the camera's count (first: frame {repeated[0] + 1}, "
            f"framestamp {stamps[repeated[0] + 1]:g} after {stamps[repeated[0]]:g}).",
        )
    skipped = np.flatnonzero(same_block & (steps > 1))
    skipped = np.array([i for i in skipped.tolist() if not _taken_again(triggers, key, i, steps[i] - 1)], np.int64)
    if skipped.size:
        lost = int((steps[skipped] - 1).sum())
        yield Finding(
            "warning",
            "framestamps",
            f"The camera counted {lost} frames that are not in the file (first gap before frame {skipped[0] + 1}).",
        )


def _taken_again(triggers: NDArray[Any], key: NDArray[Any], at: int, lost: int) -> bool:
    """Whether each trigger between a frame and the next has its frame elsewhere in the file."""
    between = np.arange(triggers[at] + 1, triggers[at + 1])
    return between.size == lost and bool(np.isin(between, triggers[key == key[at]]).all())


def frames_differ(places: Places) -> Iterator[Finding]:
    """No frame was delivered twice: noise makes every checksum new."""
    checksums = _column(places, "digest/checksum")
    same = np.flatnonzero(np.diff(checksums) == 0) if checksums.size > 1 else np.empty(0, int)
    if same.size:
        yield Finding(
            "warning",
            "stuck-frames",
            f"{same.size} frames equal the one before, pixel by pixel (first: {same[0] + 1}).",
        )


def frames_counted(places: Places) -> Iterator[Finding]:
    """The writer counted no more rows than the file has."""
    if layout.COMMITTED not in places.entry.file or places.entry.name != layout.ENTRY:
        return
    committed, n = int(places.entry.file[layout.COMMITTED][()]), places.data.shape[0]
    if committed > n:
        yield Finding("error", "unfinished", f"{committed} frames are counted as committed, but {n} are there.")


RULES: tuple[Rule, ...] = (
    definition_stated,
    lengths,
    key_codes,
    angle_units,
    time_order,
    framestamp_order,
    frames_differ,
    frames_counted,
)


def _column(places: Places, path: str) -> NDArray[Any]:
    item = datasets.dataset(places.entry, path)
    values = np.empty(0) if item is None else np.ravel(datasets.values_of(item))
    return values.astype(np.float64)
