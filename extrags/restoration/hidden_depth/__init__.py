"""Training of the network that reads the depth of what a restored view has invented."""
