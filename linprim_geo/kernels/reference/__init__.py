"""Reference implementations of the rasterizer, the losses and stereo, in plain torch and numpy: slow and independent of
the core."""
