"""From a scene to trained primitives."""
