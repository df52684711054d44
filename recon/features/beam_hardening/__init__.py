"""Beam hardening: from what a beam of several energies measured to line integrals of one."""
