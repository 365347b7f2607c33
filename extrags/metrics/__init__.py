"""Metrics of images, depth, surfaces and poses, and the evaluation protocol.

`registry` says which metrics there are; `image`, `flip`, `lpips` and `perceptual` compare images, `depth`,
`surface` and `pose` the geometry; `protocol` evaluates held-out views, `folder` reads renders made elsewhere,
`comparison` sets runs side by side. Import from those modules: the package itself loads none of them, so that
the registry costs no torch.
"""
