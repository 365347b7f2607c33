"""Pretrained restorers: diffusers pipelines, and DynamiCrafter-type checkpoints.

Needs the extra `extrags[diffusers]` (the checkpoints: the user's own clone of their code), and weights
that the user brings: nothing is downloaded unless a setting says so.

None of the adapters has been run with real weights by this project. The test suite builds each pipeline
with tiny random parts, saves it, reloads it offline and runs it; checkpoints run a tiny random model
through the same driver. Those tests show that shapes, masks, seeds, padding and files are right, not how
good the images are.
"""
