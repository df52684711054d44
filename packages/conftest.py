"""Makes the fixtures of splatline's tests available to the tests of its add-ons."""

from tests.beamline.cli.conftest import folder, no_debug
from tests.beamline.conftest import _undrawn, real_pictures
from tests.conftest import one_thread, pytest_configure, rng, shared_data

__all__ = ["_undrawn", "folder", "no_debug", "one_thread", "pytest_configure", "real_pictures", "rng", "shared_data"]
