"""What other views see and see through: thin things, outlines, backgrounds and gaps."""
