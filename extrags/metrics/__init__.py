"""Figures of merit: image, perceptual, depth, surface and pose errors, and their protocol.

`registry` says which metrics there are; `image`, `flip`, `lpips` and `perceptual` compare images, `depth`,
`surface` and `pose` the geometry; `protocol` evaluates held-out views, `folder` reads renders made elsewhere,
`comparison` sets runs side by side. Import from those modules: the package itself loads none of them, so that
the registry costs no torch.
"""
