"""What makes a surface better once it is found: its places, creases, outlines, holes and number of faces."""
