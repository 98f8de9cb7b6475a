"""The rasterizer and the losses again, in plain torch: slow, independent, for any float type."""
