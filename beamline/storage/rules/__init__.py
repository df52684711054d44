"""Rules that a scan file must meet, and the findings if it does not meet them."""

from beamline.core.flag import Finding as Finding
from beamline.core.flag import Severity as Severity
