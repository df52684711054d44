"""The PM16C's acceleration codes: ms for each 1000 pulses/s, by the preferred numbers of IEC 60063."""

from __future__ import annotations

E24 = (
    1.0,
    1.1,
    1.2,
    1.3,
    1.5,
    1.6,
    1.8,
    2.0,
    2.2,
    2.4,
    2.7,
    3.0,
    3.3,
    3.6,
    3.9,
    4.3,
    4.7,
    5.1,
    5.6,
    6.2,
    6.8,
    7.5,
    8.2,
    9.1,
)
RATES = sorted((m * 10.0**e for m in E24 for e in range(-2, 4) if 0.0155 < m * 10.0**e < 1005), reverse=True)
"""RTE code -> ms per 1000 pulses/s: the preferred numbers of IEC 60063 from 1000 down to 0.016, codes 0 to 115."""


def steepest_code(acceleration: float) -> int:
    """The code of the steepest acceleration that is not above `acceleration` (pulses/s²).

    Raises:
        ValueError: even the gentlest is above it.
    """
    codes = [code for code, ms in enumerate(RATES) if 1e6 / ms <= acceleration * (1 + 1e-9)]
    if not codes:
        raise ValueError(f"{acceleration:g} pulses/s² is gentler than the controller's gentlest, {1e6 / RATES[0]:g}")
    return codes[-1]
