"""Beam hardening taken back, by a spectrum or by the views themselves."""

from __future__ import annotations

STEPS = {"Hardening": "beam_hardening.hardening"}
