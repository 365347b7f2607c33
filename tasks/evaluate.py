"""evaluate: rendering of held-out views and extraction of the surface, and metrics as a separate stage."""

from __future__ import annotations

from typing import Literal

from extrags.config import EnhanceConfig, LpipsNet
from extrags.config.stages import Finish
from extrags.metrics.registry import PROTOCOL_VERSION
from extrags.store import Ref, Slot
from extrags.zarr_io import group_exists
from tasks.enhance import RESTORER
from tasks.stage import stage
from tasks.weights import Weights, lpips_by_net

__all__ = ["METRICS_FILE", "measure", "measure_views", "render", "restore", "restoring_settings"]

METRICS_VERSION = 10 * PROTOCOL_VERSION + 1
"""Of the protocol, and how it is computed: the last digits of the figures are another's."""
METRICS_FILE = "metrics.json"
"""`EvaluationResult.to_json()`, per-view figures included."""
VIEWS_FILE = "views.json"
"""`EvaluationResult.per_view` by the digest of the renders."""


@stage("evaluate-render", version=6)
def render(
    slot: Slot, scene: Ref, sequence: Ref, train_on: Literal["train", "all"], device: str = "cpu"
) -> None:
    """Render the held-out views at the exposure defined by the protocol, and extract the scene's surface.

    Writes `renders/`, and `mesh/` if the sequence has a true surface. `train_on` as in `coarse.train_on`.
    Views are rendered on the `device`, the surface on the processor.
    """
    from extrags import evaluation
    from extrags.devices import chosen_device
    from extrags.metrics.surface import scene_surface
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    shown, frames = slot.load(Scene, scene), slot.load(EndoscopicSequence, sequence)
    views = evaluation.render(shown.to(chosen_device(device, "device")), frames, train_on=train_on)
    slot.save(views)
    slot.counts.update(views=len(views), n_gaussians=views.n_gaussians)
    # Without true depth there is no true surface either, so the mesh is not needed.
    if frames.true_depth_mm is None:
        return
    mesh = scene_surface(shown, frames)
    if mesh is not None:
        slot.save(mesh)
    slot.counts["triangles"] = 0 if mesh is None else len(mesh.triangles)


def restoring_settings(config: EnhanceConfig, finish: Finish) -> EnhanceConfig:
    """The settings that `restore` reads, all others at their defaults: the restorer stands for these.

    Args:
        config: of the run.
        finish: the refiner alone has a precision here, which is settled for this processor.
    """
    from extrags.restoration.diffusion.precision import chosen_precision

    settings = EnhanceConfig(references=config.references, max_width=config.max_width, seed=config.seed)
    if finish != "refined":
        return settings
    return settings.model_copy(update={"precision": chosen_precision(config)})


@stage("evaluate-restore", version=18)
def restore(
    slot: Slot,
    renders: Ref,
    scene: Ref,
    sequence: Ref,
    training: Ref,
    restorer: Ref,
    config: EnhanceConfig,
    finish: Finish,
    refiner: str | None,
    shares: tuple[float, float] | None,
) -> None:
    """Restore rendered held-out views in the image; writes `renders/`, and the scene's `mesh/` again.

    Args:
        slot: the artefact to write.
        renders: of the final scene.
        scene: the coarse scene, which the restorer was made for.
        sequence: all frames.
        training: the training frames alone, with estimated depth where there is no other.
        restorer: of the scene.
        config: from `restoring_settings`.
        finish: see `extrags.restoration.restored_renders.restored_renders`.
        refiner: digest of the refiner, where it is used; only part of the key.
        shares: of the restored views, where the scene knows the surface and where it is invented; None where
            nothing was judged.
    """
    from extrags.metrics.protocol import RenderedViews
    from extrags.restoration.backends import load_enhancer
    from extrags.restoration.restored_renders import RestoredShares, restored_renders
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence
    from extrags.surface import Mesh

    views = restored_renders(
        slot.load(Scene, scene),
        slot.load(RenderedViews, renders),
        slot.load(EndoscopicSequence, sequence),
        slot.load(EndoscopicSequence, training),
        load_enhancer(slot.open(restorer) / RESTORER),
        config,
        finish=finish,
        shares=None if shares is None else RestoredShares(*shares),
    )
    slot.save(views)
    slot.counts["views"] = len(views)
    if group_exists(slot.open(renders) / Mesh.stored_as):
        slot.save(slot.load(Mesh, renders))


# Metrics are separate stages, so that a new version of the protocol does not repeat the rendering.
@stage("evaluate-views", version=METRICS_VERSION, ignore=("weights",))
def measure_views(
    slot: Slot,
    renders: list[Ref],
    sequence: Ref,
    lpips_digests: dict[LpipsNet, str | None],
    weights: list[Weights],
    added: list[str],
    device: str = "cpu",
) -> None:
    """Figures of each held-out view, of several stacks of renders at once; writes `views.json`.

    LPIPS then looks at each frame once for all stacks. `lpips_digests` names the backbones of LPIPS with the
    digests of their weights, None for missing ones. `added` names the metrics that a program has registered
    beside the protocol's (`extrags.metrics.registry.added_metrics`). Colour is compared on the `device`.
    """
    from extrags.devices import chosen_device
    from extrags.metrics.protocol import RenderedViews, figures_per_view
    from extrags.sequence import EndoscopicSequence

    _check_added(added)
    frames = slot.load(EndoscopicSequence, sequence)
    stacks = [slot.load(RenderedViews, ref) for ref in renders]
    place = chosen_device(device, "device")
    found = figures_per_view(stacks, frames, frames.test, lpips_by_net(weights), device=place)
    by_digest = {ref.digest: views for ref, views in zip(renders, found, strict=True)}
    slot.save_json(VIEWS_FILE, by_digest, indent=1)
    slot.counts.update(stacks=len(by_digest), views=len(frames.test))


# What the views have been measured to be follows from the renders: whether it was at hand is not in the key.
@stage("evaluate", version=METRICS_VERSION, ignore=("weights", "views"))
def measure(
    slot: Slot,
    renders: Ref,
    sequence: Ref,
    lpips_digests: dict[LpipsNet, str | None],
    weights: list[Weights],
    added: list[str],
    views: Ref | None = None,
    device: str = "cpu",
) -> None:
    """Metrics of rendered views and of the surface; writes `metrics.json`.

    `views` is what `measure_views` made of these renders among others; without it they are measured here. The
    other arguments are those of `measure_views`.
    """
    from data_catalog.true_surface import true_surface
    from extrags.devices import chosen_device
    from extrags.evaluation import evaluate_renders
    from extrags.metrics.comparison import figure_of
    from extrags.metrics.protocol import RenderedViews
    from extrags.metrics.registry import figures, metric_named
    from extrags.sequence import EndoscopicSequence
    from extrags.surface import Mesh

    _check_added(added)
    frames = slot.load(EndoscopicSequence, sequence)
    result = evaluate_renders(
        slot.load(RenderedViews, renders),
        frames,
        mesh=slot.load(Mesh, renders) if group_exists(slot.open(renders) / Mesh.stored_as) else None,
        true_surface=None if frames.true_depth_mm is None else true_surface(frames),
        lpips=lpips_by_net(weights),
        per_view=None if views is None else slot.load_json(VIEWS_FILE, views)[renders.digest],
        # Where the views were measured before, there is nothing to compute on it.
        device="cpu" if views is not None else chosen_device(device, "device"),
    )
    slot.save_json(METRICS_FILE, result.to_json(), indent=1)
    for figure in figures("counts"):
        if metric_named(figure.key).lpips_net is None or figure.key in result.metrics:
            slot.counts[figure.key] = figure_of(result.metrics, figure.name)


def _check_added(added: list[str]) -> None:
    from extrags.errors import ConfigError
    from extrags.metrics.registry import added_metrics

    if added != added_metrics():
        raise ConfigError(
            f"metrics to be measured beside the protocol's: {', '.join(added) or 'none'}; registered in this "
            f"process: {', '.join(added_metrics()) or 'none'}. Register them in every process of the run"
        )
