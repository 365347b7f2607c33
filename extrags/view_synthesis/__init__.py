"""What real views say about a virtual one: references, warping, light transfer, filling of holes."""
