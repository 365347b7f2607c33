"""UC-NeRF: a radiance field conditioned on uncertainty-aware multi-view stereo; `--method uc-nerf`.

`stereo` finds depth and its uncertainty in the frustum of any view, `field` renders rays from it and from the
source views, `scene` joins both with the training frames, `training` fits them, `rendering` shows held-out
views to the evaluation. docs/algorithms/uc_nerf.md has the equations and what differs from the publication.
"""
