"""Phase retrieval of a scan: its filter, by what the file and the options say of material, energy and distance."""

from __future__ import annotations

from beamline.core.errors import ConfigError
from beamline.projections.selection import Selection, cone_of, pixel_size
from beamline.storage.readers.base import ScanSource
from recon.prep.phase import Paganin, length_of


def filter_of(source: ScanSource, selection: Selection) -> tuple[Paganin | None, str]:
    """The filter for the pixels that the selection makes, and a sentence about it; None and "" where none is wanted.

    Raises:
        ConfigError: distance, energy or pixel size are not known, or give a filter that is wider than the frame.
    """
    phase = selection.phase
    if phase is None:
        return None, ""
    cone, pitch = cone_of(source, selection), pixel_size(source, selection)
    energy = source.energy_kev if phase.energy_kev is None else phase.energy_kev
    distance = phase.distance_mm
    if distance is None:
        distance = _stated(source) if cone is None else cone[1] - cone[0]
    known = {"--distance-mm": distance, "--energy-kev": energy, "--pixel-size-um": pitch}
    if missing := [option for option, value in known.items() if value is None]:
        raise ConfigError(f"--phase needs {' and '.join(missing)}, which {source.path} does not say.")
    assert distance is not None and energy is not None and pitch is not None
    try:
        ratio = phase.delta_beta(energy)
    except ValueError as error:
        raise ConfigError(f"--phase paganin:{phase.material}: {error}") from error
    said = f"delta/beta {ratio:.4g} at {energy:g} keV, {distance:g} mm behind the sample"
    if cone is not None:
        distance, pitch = distance * cone[0] / (cone[0] + distance), pitch * cone[0] / cone[1]
    found = Paganin(length_of(ratio, distance, energy, pitch * selection.binning), phase.unsharp)
    if found.length > max(source.shape) / selection.binning:
        raise ConfigError(
            f"--phase: {said}, is a filter over {found.length:.4g} pixels; {source.path} has "
            f"{source.shape[0]} x {source.shape[1]}. Check ratio, energy (keV) and distance (mm)."
        )
    mask = "" if found.unsharp is None else "; unsharp mask of {:g} px by {:g}".format(*found.unsharp)
    return found, f"Phase: Paganin's filter over {found.length:.3g} pixels ({said}){mask}."


def _stated(source: ScanSource) -> float | None:
    """mm from the sample to the detector by the file; none of 0, which is where nobody measured it."""
    stated = source.attributes.get("distance_mm")
    return stated if isinstance(stated, float) and stated > 0 else None
