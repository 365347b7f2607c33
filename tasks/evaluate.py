"""evaluate: held-out views and the surface rendered once, metrics as a stage of their own."""

from __future__ import annotations

import json

from extrags.store import Ref, Slot
from tasks.stage import stage
from tasks.weights import Weights

__all__ = ["METRICS_FILE", "measure", "render"]

METRICS_FILE = "metrics.json"
"""`EvaluationResult.to_json()`, per-view figures included."""


@stage("evaluate-render", version=3)
def render(slot: Slot, scene: Ref, sequence: Ref) -> None:
    """Render the held-out views at the exposure the protocol gives them, and fuse the scene's surface.

    Writes `renders/`; and `mesh/` where there is a true surface to hold it against.
    """
    import numpy as np
    import torch

    from extrags.events import Progress, emit
    from extrags.metrics.protocol import RenderedViews
    from extrags.metrics.surface import scene_surface
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    shown = Scene.load(slot.open(scene) / "scene")
    posed = EndoscopicSequence.load(slot.open(sequence) / "sequence")
    gains = None
    if shown.light is not None:
        gains = shown.light.exposures_of(posed.test, posed.train, posed.recording)
    rgb, alpha, depth = [], [], []
    with torch.no_grad():
        for done, frame in enumerate(posed.test, start=1):
            exposure = None if gains is None else gains[done - 1 : done]
            rendering = shown.render(posed.cameras[int(frame)], exposure=exposure)
            rgb.append(rendering.rgb[0].numpy())
            alpha.append(rendering.alpha[0].numpy())
            depth.append(rendering.depth[0].numpy())
            emit(Progress("render", done, len(posed.test)))
    views = RenderedViews(np.stack(rgb), np.stack(alpha), np.stack(depth), len(shown.gaussians))
    views.save(slot.path / "renders")
    slot.counts.update(views=len(views), n_gaussians=views.n_gaussians)
    # Without true depth there is no true surface either: nothing to fuse for.
    if posed.depth_mm is None:
        return
    mesh = scene_surface(shown, posed)
    if mesh is not None:
        mesh.save(slot.path / "mesh")
    slot.counts["triangles"] = 0 if mesh is None else len(mesh.triangles)


PROTOCOL_VERSION = 3
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
    """Metrics of rendered views and of the surface; writes `metrics.json`."""
    from data_catalog.true_surface import true_surface
    from extrags.metrics.lpips import Lpips
    from extrags.metrics.protocol import RenderedViews, evaluate_views
    from extrags.metrics.surface import evaluate_surface
    from extrags.sequence import EndoscopicSequence
    from extrags.surface import Mesh

    posed = EndoscopicSequence.load(slot.open(sequence) / "sequence")
    place = slot.open(renders)
    lpips = None if weights.path is None else Lpips.load(weights.path, net=weights.net)
    truth = None if posed.depth_mm is None else true_surface(posed)
    surface = None
    if truth is not None:
        mesh = Mesh.load(place / "mesh") if (place / "mesh").exists() else None
        surface = evaluate_surface(mesh, truth, posed)
    result = evaluate_views(
        RenderedViews.load(place / "renders"),
        posed,
        posed.test,
        lpips,
        lpips_reason=weights.reason,
        surface=surface,
        surface_reason="the sequence has no true depth",
    )
    (slot.path / METRICS_FILE).write_text(json.dumps(result.to_json(), indent=1))
    for name in ("psnr", "ssim", "lpips_alex"):
        slot.counts[name] = result.metrics.get(name)
    slot.counts["fscore"] = result.metrics["surface"]["fscore"]
