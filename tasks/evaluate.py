"""evaluate: held-out views rendered once, metrics as a stage of their own."""

from __future__ import annotations

import json

from extrags.store import Ref, Slot
from tasks.stage import stage
from tasks.weights import Weights

__all__ = ["measure", "render"]


@stage("evaluate-render", version=1)
def render(slot: Slot, scene: Ref, sequence: Ref) -> None:
    """Render the held-out views at the training frames' mean exposure; writes `renders/`."""
    import numpy as np
    import torch

    from extrags.events import Progress, emit
    from extrags.metrics.protocol import RenderedViews
    from extrags.scene import Scene
    from extrags.sequence import Sequence

    shown = Scene.load(slot.open(scene) / "scene")
    posed = Sequence.load(slot.open(sequence) / "sequence")
    rgb, alpha, depth = [], [], []
    with torch.no_grad():
        for done, frame in enumerate(posed.test, start=1):
            rendering = shown.render(posed.cameras[int(frame)])
            rgb.append(rendering.rgb[0].numpy())
            alpha.append(rendering.alpha[0].numpy())
            depth.append(rendering.depth[0].numpy())
            emit(Progress("render", done, len(posed.test)))
    views = RenderedViews(np.stack(rgb), np.stack(alpha), np.stack(depth), len(shown.gaussians))
    views.save(slot.path / "renders")
    slot.counts.update(views=len(views), n_gaussians=views.n_gaussians)


PROTOCOL_VERSION = 1
"""`extrags.metrics.protocol.PROTOCOL_VERSION`, written down again: importing it would load torch in every
process that only looks up keys. A test holds the two together."""


# Metrics are a stage of their own: raising the protocol's version measures again without a new render.
@stage("evaluate", version=PROTOCOL_VERSION, ignore=("weights",))
def measure(
    slot: Slot,
    renders: Ref,
    sequence: Ref,
    net: str,
    weights_digest: str | None,
    weights: Weights,
) -> None:
    """Metrics of rendered views; writes `metrics.json`."""
    from extrags.metrics.lpips import Lpips
    from extrags.metrics.protocol import RenderedViews, evaluate_views
    from extrags.sequence import Sequence

    posed = Sequence.load(slot.open(sequence) / "sequence")
    lpips = None if weights.path is None else Lpips.load(weights.path, net=weights.net)
    result = evaluate_views(
        RenderedViews.load(slot.open(renders) / "renders"),
        posed,
        posed.test,
        lpips,
        lpips_reason=weights.reason,
    )
    (slot.path / "metrics.json").write_text(json.dumps(result.to_json(), indent=1))
    for name in ("psnr", "ssim", "lpips_alex"):
        slot.counts[name] = result.metrics.get(name)
