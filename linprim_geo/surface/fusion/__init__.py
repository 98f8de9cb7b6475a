"""Depth maps, and the signed distance field that they are fused into."""
