"""Dense reconstruction of a capture: its workspace folder, its maps on disk, and its fused point cloud."""
