"""Features: methods for comparison, and numbers that one command alone needs. Each is a folder or a
module.

A feature of methods is a folder: `recon.methods` reads its `METHODS`. The core imports no feature, and no feature
another, so that each can be removed, with its tests.
"""
