"""Samples: what stands in the beam, as solids, voxels and parts, and how its rays and its truth are worked out."""
