"""Rules that readers of scan files rely on, and findings where a file violates them."""

from beamline.core.flag import Finding as Finding
from beamline.core.flag import Severity as Severity
