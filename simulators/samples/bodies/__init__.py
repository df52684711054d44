"""Bodies: solids whose chords are exact."""
