"""Emission: the counts of a sample that emits, as line integrals with the weights that carry their likelihood."""

from __future__ import annotations

import numpy as np

from beamline.core.errors import ConfigError, DataError
from beamline.core.sinks import Warn
from beamline.projections.prepared import PreparedProjections
from beamline.projections.registry import in_order
from beamline.projections.selection import Selection, choose_views, geometry_of, pixel_size, rows_of
from beamline.projections.step import StepDone, options_of
from beamline.projections.views import checked_views
from beamline.storage.readers.base import EmissionOf, ScanSource
from recon.prep.correct import Projections
from recon.prep.counts import Emission, weighted_lines


def prepare_emission(
    source: ScanSource, emission_of: EmissionOf, selection: Selection, warn: Warn
) -> PreparedProjections:
    """Prepare the selected views of an emission: counts without corrections, with their survival and background.

    Raises:
        ConfigError: binning, columns or a correction, which are of views in transmission.
        DataError: the file's values are no counts, or nothing survives.
    """
    asked = [each.name for step in selection.steps for field, each in options_of(type(step)).items()
             if getattr(step, field) != getattr(type(step)(), field)]  # fmt: skip
    asked += ["--bin"] * (selection.binning > 1) + ["--cols"] * (source.cols is not None)
    asked += ["a cone beam"] * (selection.cone is not None)
    if asked:
        raise ConfigError(f"{source.path} holds counts of an emission, which do not go with {asked[0]}. Leave it out.")
    frames = checked_views(source, selection, warn).frames
    ids = frames[choose_views(source, frames, selection)]
    rows = rows_of(source, selection)
    counted = emission_of(ids, rows)
    axis_col = source.axis_col if selection.axis_col is None else selection.axis_col
    assert axis_col is not None  # lines of response are binned about it
    geometry = geometry_of(source, selection, axis_col, source.angles[ids])
    try:
        emission = Emission(counted.counts, geometry, counted.survival, counted.background)
        lines, weights = weighted_lines(emission)
    except ValueError as error:
        raise DataError(f"{source.path} cannot be reconstructed: {error}. Nothing was written.") from error
    blind = np.asarray(~weights.any(axis=0))
    projections = Projections(lines, ids, 0.0, np.ones(ids.size, np.float32), blind, weights=weights)
    return PreparedProjections(
        projections=projections,
        geometry=geometry,
        axis_col=axis_col,
        axis=None,
        held_out=None,
        n_projections=source.image_key.size,
        length_unit="px" if pixel_size(source, selection) is None else "mm",
        quantity="emission",
        done={step.name: StepDone(parameters={}) for step in in_order(selection)},
        emission=emission,
    )
