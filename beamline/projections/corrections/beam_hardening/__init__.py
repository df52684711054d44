"""Beam hardening correction, from a stated spectrum or from the projections themselves."""

STEPS = {"Hardening": "beam_hardening.hardening"}
