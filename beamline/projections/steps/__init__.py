"""The place that plug-ins import a step's values from: `step` here. New ones import `beamline.projections.step`."""
