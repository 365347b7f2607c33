"""Comparison of restorers on held-out views: `extrags bench enhance`."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from extrags.config import CoarseConfig, EnhanceConfig, PipelineConfig
from extrags.config.backends import BACKENDS
from extrags.errors import CaptureError, ConfigError
from extrags.events import Progress, emit
from extrags.metrics.lpips import LpipsByNet
from extrags.raster.bench import machine
from extrags.restoration.backends import train_enhancer
from extrags.restoration.benchmark.evaluation import (
    RestorerBenchmark,
    TrueViews,
    held_out_clips,
    restore_views,
)
from extrags.restoration.benchmark.variants import Agreed, AsRendered, Textured, WithoutReferences
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.precision import chosen_precision
from extrags.restoration.diffusion.scene_training import train_on_scene
from extrags.restoration.keyframes import Keyframes, following, make_keyframes
from extrags.restoration.protocol import Clip, Enhancer
from extrags.restoration.refinement.weights import bundled_refiner
from extrags.restoration.training_data.pairs import make_pairs
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import as_reconstructed, reconstruct
from extrags.view_synthesis.gather import gather_references
from extrags.view_synthesis.references import ReferenceViews

__all__ = [
    "AGREED",
    "METHODS",
    "NO_KEYFRAMES",
    "NO_REFERENCES",
    "RECIPES",
    "REFINED",
    "TEXTURED",
    "WITH_KEYFRAMES",
    "Method",
    "bench_enhance",
    "check_methods",
    "clip_keyframes",
    "coarse_scene",
    "compare_methods",
    "prepared",
    "with_suffix",
]

NO_REFERENCES = "/no-references"
"""Suffix of a method's name: the same restorer, not told what real views see."""
TEXTURED = "/textured"
"""Suffix of a method's name: the same restorer, with texture laid onto what it invents."""
AGREED = "/agreed"
"""Suffix of a method's name: the same restorer, whose views of a clip agree on what they have invented; so do
those with texture."""
REFINED = "/refined"
"""Suffix of a method's name: the same with texture that a network makes agree with the shapes."""
WITH_KEYFRAMES, NO_KEYFRAMES = "/keyframes", "/no-keyframes"
"""Suffixes of a method's name: the same restorer with keyframes, or every view restored alone; without
either it is as the settings say."""
USUAL_KEYFRAMES = 12
"""Of a method with keyframes where the settings have none."""

SCENE_ITERATIONS = 220
"""Steps on the scene's own pairs where the profile trains on none."""

logger = logging.getLogger(__name__)

Recipe = Callable[[Scene, EndoscopicSequence, EnhanceConfig, CoarseConfig], Enhancer]


def _unrestored(
    _scene: Scene, _sequence: EndoscopicSequence, _config: EnhanceConfig, _coarse: CoarseConfig
) -> Enhancer:
    return AsRendered()


def _learning(config: EnhanceConfig) -> EnhanceConfig:
    """Settings that train on the scene's pairs, whatever the profile says of that."""
    if config.train_iterations > 0:
        return config
    return config.model_copy(update={"train_iterations": SCENE_ITERATIONS})


def _of_backend(name: str, *, learning: bool = False, **changes: Any) -> Recipe:
    """A backend's restorer with changed settings; with `learning` it trains on the scene's pairs."""

    def recipe(
        scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig
    ) -> Enhancer:
        config = _learning(config) if learning else config
        settings = EnhanceConfig.model_validate({**config.model_dump(), "backend": name, **changes})
        return train_enhancer(scene, sequence, settings, coarse)

    return recipe


def _deterministic(
    scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig
) -> Enhancer:
    """The same network from the same pairs, trained as a plain regression from nothing."""
    pairs = make_pairs(scene, sequence, config, coarse)
    transfer = gather_references(scene, sequence, sequence.train).transfer
    return train_on_scene(pairs, transfer, _learning(config), deterministic=True)


PLAIN: dict[str, Any] = {"judge": False, "seamless_cloning": "never"}

RECIPES: dict[str, Recipe] = {
    "none": _unrestored,
    # Without `judge`: the restorer itself, also where the classical one would replace it.
    "unreplaced": _of_backend("embedded", **PLAIN),
    "scene-trained": _of_backend("embedded", learning=True, **PLAIN),
    "scratch": _of_backend("embedded", learning=True, **PLAIN, pretrained_weights="none"),
    "zero-shot": _of_backend("embedded", **PLAIN, train_iterations=0),
    "seamless": _of_backend("embedded", judge=False, seamless_cloning="always", train_iterations=0),
    "deterministic": _deterministic,
}
"""How a restorer is made for a scene, beside the backends as they are."""


@dataclass(frozen=True)
class Method:
    """A row of the table.

    Args:
        recipe: a key of `RECIPES`, or the name of a backend.
        adjust: changes the restorer after it was made; None leaves it.
    """

    recipe: str
    adjust: Callable[[Enhancer], Enhancer] | None = None


def _in_steps(steps: int) -> Callable[[Enhancer], Enhancer]:
    def adjust(enhancer: Enhancer) -> Enhancer:
        if not isinstance(enhancer, EmbeddedEnhancer):
            raise ConfigError(f"{enhancer.name} has no steps that could be set")
        return replace(enhancer, steps=steps)

    return adjust


METHODS: dict[str, Method] = {
    "none": Method("none"),
    "embedded-1": Method("unreplaced", _in_steps(1)),
    "embedded-4": Method("unreplaced", _in_steps(4)),
    "scene-trained": Method("scene-trained"),
    "scratch": Method("scratch"),
    "zero-shot": Method("zero-shot"),
    "seamless": Method("seamless"),
    "deterministic": Method("deterministic"),
}
"""Methods beside the backends as they are; every one also with a suffix, `/keyframes` for instance."""


def check_methods(names: Iterable[str]) -> list[str]:
    """The names, each once.

    Raises:
        ConfigError: for an unknown one, or none at all.
    """
    chosen = list(dict.fromkeys(names))
    known = [*METHODS, *BACKENDS]
    unknown = [name for name in chosen if _plain(name) not in known]
    if unknown or not chosen:
        raise ConfigError(
            f"unknown methods {', '.join(unknown) or '(none named)'}; expected {', '.join(known)}, "
            f"each also with {NO_REFERENCES}, {AGREED}, {TEXTURED}, {REFINED}, {WITH_KEYFRAMES} or "
            f"{NO_KEYFRAMES} behind it"
        )
    return chosen


def _plain(name: str) -> str:
    for suffix in (NO_REFERENCES, AGREED, TEXTURED, REFINED, NO_KEYFRAMES, WITH_KEYFRAMES):
        if name.endswith(suffix):
            return name.removesuffix(suffix)
    return name


def prepared(
    names: Sequence[str],
    scene: Scene,
    sequence: EndoscopicSequence,
    config: EnhanceConfig,
    coarse: CoarseConfig,
) -> Iterator[tuple[str, Enhancer, float]]:
    """The restorers of a scene, one after the other.

    Args:
        names: of methods.
        scene: the coarse scene.
        sequence: its training frames.
        config: settings of the restorers.
        coarse: settings of leave-out reconstructions.

    Yields:
        Name, restorer, and the seconds its recipe took. Methods that share a recipe share its restorer, and
        each counts all of its seconds.

    Raises:
        ConfigError: for an unknown method.
    """
    made: dict[str, tuple[Enhancer, float]] = {}
    for name in check_methods(names):
        plain = _plain(name)
        method = METHODS.get(plain, Method(plain))
        if method.recipe not in made:
            recipe = RECIPES.get(method.recipe) or _of_backend(method.recipe)
            begun = time.perf_counter()
            enhancer = recipe(scene, sequence, config, coarse)
            made[method.recipe] = enhancer, time.perf_counter() - begun
        enhancer, seconds = made[method.recipe]
        if method.adjust is not None:
            enhancer = method.adjust(enhancer)
        yield name, WithoutReferences(enhancer) if name.endswith(NO_REFERENCES) else enhancer, seconds


def coarse_scene(sequence: EndoscopicSequence, config: CoarseConfig) -> tuple[Scene, EndoscopicSequence]:
    """The coarse scene of a sequence, and the sequence as the scene belongs to it."""
    result = reconstruct(sequence.training_part(), config)
    return result.scene, as_reconstructed(sequence, result)


def compare_methods(
    scene: Scene,
    sequence: EndoscopicSequence,
    config: PipelineConfig,
    methods: Sequence[str],
    lpips: LpipsByNet | None,
) -> list[dict[str, Any]]:
    """Compare methods on the held-out views of a sequence, as a run restores them.

    Frames through a lens become pinholes, and frames wider than `enhance.max_width` are shrunk to it.

    Args:
        scene: its coarse scene.
        sequence: with the held-out frames; restorers are given the training frames alone.
        config: settings; `enhance` and `coarse` count.
        methods: names. Keyframes are chosen among the held-out views.
        lpips: LPIPS by backbone; None leaves it out.

    Returns:
        One case per method: `{sequence, seed, method, steps, domain_score, trained_on, psnr, ssim,
        lpips_alex, well, hole, ..., seconds_per_frame, prepare_seconds, keyframes, keyframe_seconds,
        pixel_share, views}`; see `RestorerBenchmark.figures`.

    Raises:
        CaptureError: without held-out frames, or too few to train on.
        ConfigError: for an unknown method.
    """
    methods = check_methods(methods)
    # Restorers see pinholes of the working size, as in a run.
    width = config.enhance.working_width(sequence.width)
    if width < sequence.width:
        logger.info("bench enhance: %s is compared %d pixels wide (enhance.max_width)", sequence.name, width)
    sequence = sequence.as_pinhole().at_most_width(width)
    training = sequence.training_part()
    references = gather_references(scene, training, training.train)
    clips = held_out_clips(
        scene, references, sequence, np.asarray(sequence.test), count=config.enhance.references
    )
    benchmark = RestorerBenchmark(clips, TrueViews.of_sequence(sequence, np.asarray(sequence.test)), lpips)
    cases = []
    restorers = prepared(methods, scene, training, config.enhance, config.coarse)
    for done, (name, enhancer, seconds) in enumerate(restorers, start=1):
        keyed = _keyed(name, config.enhance)
        begun = time.perf_counter()
        keyframes = clip_keyframes(scene, references, clips, enhancer, keyed)
        keyframe_seconds = time.perf_counter() - begun
        enhancer = with_suffix(name, enhancer, references, config.enhance)
        invented = keyframes.invented(references.transfer)
        restored = restore_views(enhancer, [following(clip, invented) for clip in clips])
        figures = benchmark.figures(restored)
        cases.append(
            {
                "sequence": sequence.name,
                "seed": config.enhance.seed,
                "method": name,
                "steps": restored.provenance.get("steps"),
                "domain_score": restored.provenance.get("domain_score"),
                "trained_on": restored.provenance.get("trained_on"),
                **figures,
                "prepare_seconds": seconds,
                "keyframes": len(keyframes),
                "keyframe_seconds": keyframe_seconds,
                "pixel_share": benchmark.pixel_share,
                "views": len(benchmark.truth),
            }
        )
        logger.info("bench enhance: %s %s %.2f dB", sequence.name, name, figures["psnr"] or 0.0)
        emit(Progress("bench enhance", done, len(methods)))
    return cases


def with_suffix(name: str, enhancer: Enhancer, references: ReferenceViews, config: EnhanceConfig) -> Enhancer:
    """The restorer with what the suffix of its name asks for, beside references and keyframes.

    Args:
        name: of a method.
        enhancer: its restorer.
        references: the scene's real views, which give texture.
        config: the seed of the texture, and the refiner's precision.

    Raises:
        CaptureError: when no frame gives texture, and texture is asked for.
    """
    if name.endswith((AGREED, TEXTURED, REFINED)):
        enhancer = Agreed(enhancer)
    if name.endswith((TEXTURED, REFINED)):
        refiner = None
        if name.endswith(REFINED):
            refiner = bundled_refiner(half_precision=chosen_precision(config) == "bfloat16")
        enhancer = Textured.of_references(enhancer, references, seed=config.seed, refiner=refiner)
    return enhancer


def _keyed(name: str, config: EnhanceConfig) -> EnhanceConfig:
    """The settings with the number of keyframes of a method."""
    count = config.keyframes
    if name.endswith(NO_KEYFRAMES):
        count = 0
    elif name.endswith(WITH_KEYFRAMES):
        count = count or USUAL_KEYFRAMES
    return config.model_copy(update={"keyframes": count})


def clip_keyframes(
    scene: Scene,
    references: ReferenceViews,
    clips: Sequence[Clip],
    enhancer: Enhancer,
    config: EnhanceConfig,
) -> Keyframes:
    """The keyframes of clips that are rendered already, at the exposure of each view.

    Args:
        scene: the coarse scene.
        references: its training views.
        clips: all of them, in the order of their indices.
        enhancer: the restorer.
        config: how many keyframes.
    """
    exposure = [None if clip.exposure is None else torch.from_numpy(clip.exposure) for clip in clips]
    cameras = [clip.cameras for clip in clips]
    return make_keyframes(scene, references, cameras, enhancer, config, exposure=exposure)


def bench_enhance(
    sequences: Iterable[EndoscopicSequence],
    config: PipelineConfig,
    *,
    methods: Sequence[str] = ("none", "classical", "embedded"),
    lpips: LpipsByNet | None = None,
) -> dict[str, Any]:
    """Reconstruct each sequence and compare restorers on its held-out views.

    Args:
        sequences: with poses and held-out frames.
        config: settings of `coarse` and `enhance`, seeds included.
        methods: names of `METHODS` or of backends, possibly with a suffix: `/no-references`, `/agreed`,
            `/textured`, `/refined`, `/keyframes` or `/no-keyframes`.
        lpips: LPIPS by backbone; None leaves it out.

    Returns:
        `{machine, cases}`; see `compare_methods`. `coarse_seconds` is beside each case.

    Raises:
        CaptureError: a sequence without poses or held-out frames.
        ConfigError: for an unknown method.
    """
    methods = check_methods(methods)
    cases = []
    for sequence in sequences:
        if sequence.world_from_camera is None:
            raise CaptureError(
                f"{sequence.name} has no poses; `extrags run` estimates them, and `extrags export --to "
                "colmap` writes a folder that has them"
            )
        if len(sequence.test) == 0:
            raise CaptureError(f"{sequence.name}: no held-out frames to compare restorers on")
        begun = time.perf_counter()
        scene, posed = coarse_scene(sequence, config.coarse)
        seconds = time.perf_counter() - begun
        found = compare_methods(scene, posed, config, methods, lpips)
        cases += [{**case, "coarse_seconds": seconds} for case in found]
    return {"machine": machine(), "cases": cases}
