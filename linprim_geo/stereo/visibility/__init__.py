"""Use what other views see, or see through: thin objects, outlines, backgrounds and gaps between known points."""
