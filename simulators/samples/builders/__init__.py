"""Builders: batteries, cathodes and foams out of bodies."""
