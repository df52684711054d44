"""Commands of features are tested as the core's are."""

from tests.beamline.cli.conftest import folder, no_debug, terminal

__all__ = ["folder", "no_debug", "terminal"]
