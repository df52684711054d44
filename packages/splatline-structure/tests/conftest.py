"""Lets tests import the modules next to them by name."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
