"""Compute kernels, each beside a readable twin in `reference`; nothing here knows files, threads or devices."""
