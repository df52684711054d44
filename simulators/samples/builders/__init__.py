"""Builders: compose batteries, cathodes and foams from bodies."""
