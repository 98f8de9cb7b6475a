"""Dense depth from photographs alone: PatchMatch stereo, and its consistency between views."""
