"""From trained primitives to a mesh with colours, texture and predicted error."""
