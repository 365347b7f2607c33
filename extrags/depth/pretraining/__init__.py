"""Pretraining of the depth completion on procedural cavities, which no evaluation uses."""
