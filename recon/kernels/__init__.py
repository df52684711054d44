"""Compute kernels: cpu (numba), gpu (Triton), and the reference implementation that both are tested against.

Nothing here knows files, clocks or devices.
"""
