"""The embedded restorer: a conditional diffusion with weights of its own."""
