"""Compute kernels: cpu (numba), gpu (Triton), and the reference implementation with which both are compared in tests.

The kernels do not use files, clocks or device settings.
"""
