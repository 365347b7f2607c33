r"""Colours of Gaussians shrunk towards those of their neighbours, for views that look from elsewhere.

Training views determine what overlapping Gaussians add up to, and hardly what each of them adds: one may be
far too red where another in front of it is too pale, which no training view shows. From elsewhere, where the
one is seen without the other, it does show, and what fills a hole beside it takes its hue. With the support

.. math:: s_i = \sum_{views} g_i \sum_{pixels} w_i

of a Gaussian, its blending weights times the gain of the light, and the mean m of its neighbours j,

.. math:: c_i' = \frac{s_i c_i + \kappa m_i}{s_i + \kappa}, \qquad
          m_i = \frac{\sum_j s_j o_j c_j}{\sum_j s_j o_j}

is the estimate of a colour that was observed in s pixels and has the neighbours' as a prior worth
:math:`\kappa` of them; o are opacities. What many pixels show stays as it is.

Source: shrinkage towards a prior mean, [Efron1975].
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.cameras import Cameras
from extrags.errors import ShapeError
from extrags.raster import Rendering
from extrags.scene import Scene

__all__ = ["PRIOR_PX", "color_support", "shrunk_sh0"]

PRIOR_PX = 4.0
"""What the neighbours' mean is worth, in pixels of training views under a gain of one."""
NEIGHBOURS = 16


def color_support(scene: Scene, camera: Cameras, rendering: Rendering) -> Float[Tensor, "n"]:
    """Pixels of a view that determine the colour of each Gaussian, weighted by the light that falls there.

    Args:
        scene: on the processor.
        camera: one view.
        rendering: of it, with visibility.

    Raises:
        ShapeError: when it was rendered without `visibility=True`.
    """
    if rendering.visibility_sum is None:
        raise ShapeError("the rendering carries no visibility; ask for it with visibility=True")
    support = rendering.visibility_sum[0]
    if scene.light is None:
        return support
    from_world = torch.from_numpy(camera.viewmats[0]).to(support)
    with torch.no_grad():
        gain = scene.light.gain(scene.gaussians.means @ from_world[:3, :3].T + from_world[:3, 3])
    return support * gain


def shrunk_sh0(scene: Scene, support: Float[Tensor, "n"]) -> Float[Tensor, "n 1 3"]:
    """Constant harmonics of the Gaussians, each drawn towards its neighbours' the more, the less supported.

    Args:
        scene: on the processor.
        support: sum of `color_support` over the training views.

    Raises:
        ShapeError: when there is not one value for each Gaussian.
    """
    from scipy.spatial import cKDTree

    gaussians = scene.gaussians
    if support.shape != (len(gaussians),):
        raise ShapeError(f"support of {tuple(support.shape)} for {len(gaussians)} Gaussians")
    count = min(NEIGHBOURS, len(gaussians) - 1)
    if count < 1:
        return gaussians.sh0
    means = gaussians.means.detach().numpy()
    found = cKDTree(means).query(means, k=count + 1)[1]
    # Itself among them, but where as many others lie in its very place: then one of these is left out.
    itself = found == np.arange(len(means))[:, None]
    itself[~itself.any(axis=1), -1] = True
    nearest = torch.from_numpy(found[~itself].reshape(-1, count))
    own = gaussians.sh0[:, 0].detach()
    weight = (support * gaussians.opacities.detach().sigmoid())[nearest]
    total = weight.sum(dim=1, keepdim=True)
    mean = (own[nearest] * weight[..., None]).sum(dim=1) / total.clamp_min(1e-12)
    # Where no neighbour was seen either, nothing tells better.
    mean = torch.where(total > 0, mean, own)
    share = (PRIOR_PX / (support + PRIOR_PX))[:, None]
    return torch.lerp(own, mean, share)[:, None].contiguous()
