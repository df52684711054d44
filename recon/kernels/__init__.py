"""Compute kernels, each beside a readable twin in `reference`; nothing here knows files, clocks or devices."""

from recon.base import threads as threads
