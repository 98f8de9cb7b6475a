"""Dense depth from photographs alone: PatchMatch stereo, consistency between views, and planes of surfaces without
texture."""
