"""Beam hardening taken back, by a spectrum or by the views themselves."""

STEPS = {"Hardening": "beam_hardening.hardening"}
