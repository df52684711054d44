"""Files of scenes and their ground truth, for all features that use scenes."""
