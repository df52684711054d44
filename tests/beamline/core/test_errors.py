"""Our errors can be pickled, because an error that cannot be restored would hang a worker pool."""

import copy
import pickle

import pytest

from beamline.core.errors import ConfigError
from beamline.features.queue.scans import QueueError
from beamline.scan.ledger import LedgerError
from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.dcam.abi import DcamError


@pytest.mark.parametrize(
    "error",
    [
        ConfigError("bad"),
        LedgerError("two are missing", [4, 7]),
        QueueError("one of two", 5),
        DeviceError("stage", "it stalled", request="home", advice="look"),
        DeviceTimeout("camera", "no frame came"),
        DcamError("camera", "dcam_open 1", -2147483386),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_error_is_copied_with_its_parts(error: Exception) -> None:
    error.add_note("said at the pass")
    for copied in (copy.copy(error), copy.deepcopy(error), pickle.loads(pickle.dumps(error))):  # noqa: S301
        assert (type(copied), str(copied), vars(copied)) == (type(error), str(error), vars(error))
