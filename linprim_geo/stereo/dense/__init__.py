"""Dense reconstruction of a capture: its folder, its maps on disk, its cloud of points."""
