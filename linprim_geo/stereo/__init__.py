"""Dense depth from photographs alone: PatchMatch stereo, its consistency between views, and fused points."""
