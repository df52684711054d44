"""Commands of features are tested in the same way as those of the core."""

from tests.beamline.cli.conftest import folder, no_debug, terminal

__all__ = ["folder", "no_debug", "terminal"]
