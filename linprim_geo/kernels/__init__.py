"""The only package that calls the compiled core: rasterizer, losses, optimiser, stereo, TSDF, operators on surfaces."""
