"""Phase: contrast from the bright rims of a propagated wave."""
