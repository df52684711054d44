"""Features: methods for comparison, and numbers that one command alone needs. Each is a folder.

A feature enters by its folder: `recon.methods` reads `METHODS` of each. The core imports no feature, and no feature
another, so that a folder can be removed, with its tests.
"""
