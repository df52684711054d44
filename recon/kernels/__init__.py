"""Compute kernels, each beside a readable twin in `reference`; nothing here knows files, clocks or devices."""

from recon import threads  # noqa: F401 - settles the threads before any kernel starts them
