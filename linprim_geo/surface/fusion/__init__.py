"""Fuses depth maps into a signed distance field on a sparse voxel grid."""
