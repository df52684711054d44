"""Builders: batteries, cathodes, foams and resolution patterns out of bodies."""
