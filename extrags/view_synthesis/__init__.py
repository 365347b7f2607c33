"""What a virtual view can be told from real ones: references, warp, light transfer, filling."""
