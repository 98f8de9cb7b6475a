"""Python interface of the compiled core, and the only package that calls it: rasterizer, losses, optimiser, stereo,
TSDF fusion, surface operators."""
