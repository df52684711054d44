"""Samples: solids, voxels and materials in the beam, their line integrals and their true attenuation."""
