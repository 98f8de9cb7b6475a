"""The only door to the compiled core: the rasterizer, the losses, Adam."""
