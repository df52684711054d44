"""Features: further reconstruction methods and computations that only one command needs. Each is a folder or a module.

A feature with reconstruction methods is a folder; `recon.methods` reads its `METHODS`. The core imports no feature, and
a feature imports no other one, so that each can be removed together with its tests.
"""
