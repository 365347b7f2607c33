"""The protocol: which pixels count where, stable keys, and nothing that JSON cannot hold."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from extrags.errors import NonFiniteError, ShapeError, SourceNotFoundError
from extrags.events import Event, subscribed
from extrags.metrics import protocol
from extrags.metrics.image import psnr
from extrags.metrics.lpips import Lpips
from extrags.metrics.protocol import (
    PROTOCOL_VERSION,
    EvaluationResult,
    RenderedViews,
    evaluate_views,
    figures_per_view,
)
from extrags.metrics.surface import SurfaceErrors, SurfaceResult
from extrags.raster import native
from extrags.sequence import EndoscopicSequence, Split
from tests.extrags.random_lpips import random_weights

FRAMES, HEIGHT, WIDTH = 5, 48, 64
TEST = np.array([1, 3])


@pytest.fixture
def sequence() -> EndoscopicSequence:
    rng = np.random.default_rng(0)
    mask = np.ones((FRAMES, HEIGHT, WIDTH), dtype=bool)
    mask[:, :, :8] = False
    observed = np.zeros((FRAMES, HEIGHT, WIDTH), dtype=bool)
    observed[1, :, :40] = True
    observed[3] = True
    return EndoscopicSequence(
        name="made/up@here",
        rgb=rng.integers(40, 200, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8),
        K=np.tile(np.eye(3), (FRAMES, 1, 1)),
        mask=mask,
        split=Split("here", np.array([0, 2, 4]), TEST),
        depth_mm=np.full((FRAMES, HEIGHT, WIDTH), 20.0, dtype=np.float32),
        observed=observed,
    )


def renders_of(sequence: EndoscopicSequence, frames: np.ndarray) -> RenderedViews:
    rgb = sequence.rgb[frames].astype(np.float32) / 255
    return RenderedViews(
        rgb=rgb,
        alpha=np.ones(rgb.shape[:-1], dtype=np.float32),
        depth_mm=np.full(rgb.shape[:-1], 22.0, dtype=np.float32),
        n_gaussians=7,
    )


def test_perfect_renders(sequence: EndoscopicSequence) -> None:
    result = evaluate_views(renders_of(sequence, TEST), sequence, TEST, None)
    metrics = result.metrics
    assert metrics["psnr"] == pytest.approx(100, abs=0.1)
    assert metrics["ssim"] == pytest.approx(1, abs=1e-4)
    assert metrics["flip"] == pytest.approx(0, abs=1e-4)
    assert metrics["depth_absrel"] == pytest.approx(0.1)
    assert metrics["depth_rmse"] == pytest.approx(2)
    assert metrics["n_gaussians"] == 7
    assert metrics["aligned"]["gain"] == pytest.approx(1, abs=1e-4)
    assert result.protocol == PROTOCOL_VERSION


def test_stable_keys_and_json(sequence: EndoscopicSequence) -> None:
    given = {"alex": "no LPIPS weights were given"}
    result = evaluate_views(renders_of(sequence, TEST), sequence, TEST, given)
    tree = json.loads(json.dumps(result.to_json(), allow_nan=False))
    photometric = {"psnr", "ssim", "lpips_alex", "flip"}
    keys = photometric | {"depth_absrel", "n_gaussians", "aligned", "observed", "unobserved", "whole"}
    assert keys <= set(tree["metrics"])
    for group in ("aligned", "observed", "unobserved", "whole"):
        assert photometric <= set(tree["metrics"][group])
    assert tree["metrics"]["lpips_alex"] is None
    assert tree["reasons"] == {
        "lpips_alex": "no LPIPS weights were given",
        "surface": "no surface was given",
    }
    assert tree["metrics"]["surface"]["accuracy_mm"] is None
    assert tree["true_surface"] is None
    assert [view["name"] for view in tree["per_view"]] == ["0001", "0003"]
    assert tree["n_views"] == 2


def test_several_stacks_at_once_have_the_figures_of_each_alone(
    sequence: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = Lpips("alex", random_weights("alex"))
    clean = renders_of(sequence, TEST)
    dark = replace(clean, rgb=0.7 * clean.rgb, depth_mm=1.1 * clean.depth_mm)
    alone = [evaluate_views(renders, sequence, TEST, {"alex": network}) for renders in (clean, dark)]
    assert alone[1].metrics["lpips_alex"] > alone[1].metrics["aligned"]["lpips_alex"]
    seen = 0
    activations = Lpips.activations

    def counted(lpips: Lpips, images: torch.Tensor) -> object:
        nonlocal seen
        seen += len(images)
        return activations(lpips, images)

    monkeypatch.setattr(Lpips, "activations", counted)
    together = figures_per_view([clean, dark], sequence, TEST, {"alex": network})
    assert together == [result.per_view for result in alone]
    # Per frame: the target inside the mask and whole; of both stacks plain, aligned and whole.
    assert seen == len(TEST) * (2 + 2 * 3)
    again = evaluate_views(dark, sequence, TEST, {"alex": network}, per_view=together[1])
    assert again == alone[1]


def test_masked_out_pixels_do_not_count(sequence: EndoscopicSequence) -> None:
    clean = renders_of(sequence, TEST)
    spoiled = clean.rgb.copy()
    spoiled[~sequence.mask[TEST]] = 1
    result = evaluate_views(replace(clean, rgb=spoiled), sequence, TEST, None)
    reference = evaluate_views(clean, sequence, TEST, None)
    for group in ("observed", "unobserved", "aligned"):
        assert result.metrics[group] == reference.metrics[group]
    assert result.metrics["psnr"] == reference.metrics["psnr"]
    assert result.metrics["ssim"] == reference.metrics["ssim"]
    assert result.metrics["whole"]["psnr"] < 25


def test_what_has_no_true_depth_is_in_neither_part(sequence: EndoscopicSequence) -> None:
    assert sequence.depth_mm is not None
    assert sequence.observed is not None
    depth, observed = sequence.depth_mm.copy(), sequence.observed.copy()
    depth[1, :24] = 0
    observed[1, :24] = False
    depth[3], observed[3] = 0, False
    result = evaluate_views(
        renders_of(sequence, TEST), replace(sequence, depth_mm=depth, observed=observed), TEST, None
    )
    first, second = result.per_view
    assert first["observed"]["pixel_share"] == pytest.approx(0.5 * 32 / 56)
    assert first["unobserved"]["pixel_share"] == pytest.approx(0.5 * 24 / 56)
    # Of a frame without depth nothing is known, not even the share.
    for part in ("observed", "unobserved"):
        assert second[part]["psnr"] is None
        assert second[part]["pixel_share"] is None


def test_observed_and_unobserved_stand_apart(sequence: EndoscopicSequence) -> None:
    renders = renders_of(sequence, TEST)
    renders.rgb[0, :, 40:] *= 0.5
    result = evaluate_views(renders, sequence, TEST, None)
    first, second = result.per_view
    assert first["observed"]["psnr"] == pytest.approx(100, abs=0.1)
    target = torch.from_numpy(sequence.rgb[1].astype(np.float32) / 255)
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, 40:] = True
    halved = (0.5 * target * 255).round() / 255
    assert first["unobserved"]["psnr"] == pytest.approx(psnr(halved, target, mask), abs=1e-4)
    assert first["unobserved"]["pixel_share"] == pytest.approx(24 / 56)
    # The second view has no unobserved pixel: no figure, and the mean is the first view's.
    assert second["unobserved"]["psnr"] is None
    assert second["unobserved"]["pixel_share"] == 0
    assert result.metrics["unobserved"]["psnr"] == first["unobserved"]["psnr"]
    assert result.metrics["unobserved"]["pixel_share"] == pytest.approx(12 / 56)


def test_a_few_pixels_are_no_part(sequence: EndoscopicSequence) -> None:
    assert sequence.observed is not None
    observed = sequence.observed.copy()
    observed[1] = True
    observed[1, 0, 20:28] = False
    result = evaluate_views(renders_of(sequence, TEST), replace(sequence, observed=observed), TEST, None)
    assert result.metrics["unobserved"]["psnr"] is None
    assert result.reasons["unobserved"] == "no view has 0.3% of its pixels unobserved"
    assert result.per_view[0]["unobserved"]["pixel_share"] == pytest.approx(8 / (48 * 56))


def test_exposure_is_mended_in_its_own_place_only(sequence: EndoscopicSequence) -> None:
    clean = renders_of(sequence, TEST)
    dim = replace(clean, rgb=clean.rgb * np.array([0.6, 0.9], dtype=np.float32)[:, None, None, None])
    result = evaluate_views(dim, sequence, TEST, None)
    assert result.metrics["psnr"] < 30
    # What 8 bits of a dim render leave: far above any real error.
    assert result.metrics["aligned"]["psnr"] > 50
    assert [view["aligned"]["gain"] for view in result.per_view] == pytest.approx(
        [1 / 0.6, 1 / 0.9], rel=1e-3
    )
    assert result.metrics["observed"]["psnr"] < 30
    assert result.metrics["observed"]["aligned"]["psnr"] > 50


def test_empty_render_has_depth_coverage_only(sequence: EndoscopicSequence) -> None:
    clean = renders_of(sequence, TEST)
    alpha = clean.alpha.copy()
    alpha[:, :, :36] = 0.2
    result = evaluate_views(replace(clean, alpha=alpha), sequence, TEST, None)
    assert result.metrics["depth_coverage"] == pytest.approx(0.5)
    assert result.metrics["depth_absrel"] == pytest.approx(0.1)


def test_a_view_in_which_nothing_is_rendered_lowers_the_coverage(sequence: EndoscopicSequence) -> None:
    clean = renders_of(sequence, TEST)
    alpha = clean.alpha.copy()
    alpha[0] = 0.2
    result = evaluate_views(replace(clean, alpha=alpha), sequence, TEST, None)
    assert result.metrics["depth_coverage"] == pytest.approx(1 - 1 / len(TEST))
    assert result.metrics["depth_absrel"] == pytest.approx(0.1)
    assert (result.per_view[0]["depth_coverage"], result.per_view[0]["depth_absrel"]) == (0, None)


def test_what_cannot_be_had_is_null_with_a_reason(sequence: EndoscopicSequence) -> None:
    bare = replace(sequence, depth_mm=None, observed=None)
    result = evaluate_views(renders_of(bare, TEST), bare, TEST, {"alex": "no file"})
    assert result.metrics["depth_absrel"] is None
    assert result.metrics["observed"]["psnr"] is None
    assert result.metrics["observed"]["pixel_share"] is None
    assert result.reasons == {
        "lpips_alex": "no file",
        "depth_absrel": "the sequence has no true depth",
        "observed": "the source does not tell which surface the training frames saw",
        "unobserved": "the source does not tell which surface the training frames saw",
        "surface": "no surface was given",
    }


def test_training_frames_have_no_parts(sequence: EndoscopicSequence) -> None:
    train = sequence.train
    result = evaluate_views(renders_of(sequence, train), sequence, train, None)
    assert result.metrics["unobserved"]["psnr"] is None
    assert result.reasons["unobserved"] == "told apart for held-out frames only"


def test_an_empty_mask_gives_nulls_not_nans(sequence: EndoscopicSequence) -> None:
    mask = sequence.mask.copy()
    mask[3] = False
    blind = replace(sequence, mask=mask)
    result = evaluate_views(renders_of(blind, TEST), blind, TEST, None)
    assert result.per_view[1]["psnr"] is None
    assert result.per_view[1]["aligned"]["gain"] is None
    assert result.metrics["psnr"] == result.per_view[0]["psnr"]
    json.dumps(result.to_json(), allow_nan=False)
    nothing = replace(sequence, mask=np.zeros_like(mask))
    result = evaluate_views(renders_of(nothing, TEST), nothing, TEST, None)
    assert result.metrics["psnr"] is None
    assert "empty" in result.reasons["psnr"]


def test_images_too_small_for_lpips_have_all_other_figures(sequence: EndoscopicSequence) -> None:
    small = replace(
        sequence,
        rgb=sequence.rgb[:, :20, :24],
        mask=sequence.mask[:, :20, :24],
        depth_mm=None,
        observed=None,
    )
    networks = {"alex": Lpips("alex", random_weights("alex"))}
    result = evaluate_views(renders_of(small, TEST), small, TEST, networks)
    assert result.metrics["lpips_alex"] is None
    assert result.reasons["lpips_alex"] == "LPIPS needs images of at least 32 px a side, these have 24 x 20"
    assert result.metrics["ssim"] == pytest.approx(1, abs=1e-4)


def test_lpips_inside_the_mask(sequence: EndoscopicSequence, shared_data: Path) -> None:
    metric = Lpips.load(shared_data / "lpips_weights")
    clean = renders_of(sequence, TEST)
    rng = np.random.default_rng(1)
    levels = np.rint(np.clip(clean.rgb + rng.normal(0, 0.1, clean.rgb.shape), 0, 1) * 255)
    noisy = replace(clean, rgb=levels.astype(np.float32) / 255)
    result = evaluate_views(noisy, sequence, TEST, {"alex": metric})
    whole = metric.distance(
        torch.from_numpy(noisy.rgb), torch.from_numpy(sequence.rgb[TEST].astype(np.float32) / 255)
    )
    assert result.metrics["whole"]["lpips_alex"] == pytest.approx(float(whole.mean()), abs=1e-5)
    assert 0 < result.metrics["lpips_alex"] < 1
    assert result.metrics["unobserved"]["lpips_alex"] > 0


def test_each_backbone_of_lpips_that_was_asked_for_has_figures_in_every_group(
    sequence: EndoscopicSequence, shared_data: Path, caplog: pytest.LogCaptureFixture
) -> None:
    clean = renders_of(sequence, TEST)
    noise = np.random.default_rng(1).normal(0, 0.1, clean.rgb.shape).astype(np.float32)
    noisy = replace(clean, rgb=clean.rgb + noise)
    given = {
        "alex": Lpips.load(shared_data / "lpips_weights"),
        "vgg": Lpips.load(shared_data / "lpips_weights", "vgg"),
    }
    both = evaluate_views(noisy, sequence, TEST, given)
    for tree in (both.metrics, *both.per_view):
        for path in ("", "whole", "aligned", "observed", "unobserved", "observed.aligned"):
            group = tree
            for name in filter(None, path.split(".")):
                group = group[name]
            assert (group["lpips_vgg"] is None) == (group["psnr"] is None)
            if group["lpips_vgg"] is not None:
                assert group["lpips_vgg"] > 0
                assert group["lpips_vgg"] != group["lpips_alex"]
            assert "lpips_squeeze" not in group
    assert both.metrics["unobserved"]["lpips_vgg"] is not None
    assert not {"lpips_alex", "lpips_vgg"} & set(both.reasons)
    assert "lpips_vgg" not in evaluate_views(noisy, sequence, TEST, {"alex": given["alex"]}).metrics
    assert not any(key.startswith("lpips") for key in evaluate_views(noisy, sequence, TEST, None).metrics)

    missing = evaluate_views(noisy, sequence, TEST, {**given, "vgg": "no file of VGG"})
    assert missing.metrics["lpips_vgg"] is None
    assert missing.metrics["lpips_alex"] == both.metrics["lpips_alex"]
    assert missing.reasons["lpips_vgg"] == "no file of VGG"
    assert "LPIPS with vgg is not measured: no file of VGG" in caplog.text


def test_same_bits_twice_and_whatever_the_batch(
    sequence: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    renders = renders_of(sequence, TEST)
    renders.rgb[:, 10:20] = 0.3
    once = evaluate_views(renders, sequence, TEST, None).to_json()
    assert evaluate_views(renders, sequence, TEST, None).to_json() == once
    monkeypatch.setattr(protocol, "_PIXELS_AT_ONCE", 1)
    single = evaluate_views(renders, sequence, TEST, None)
    assert single.metrics["psnr"] == pytest.approx(once["metrics"]["psnr"], abs=1e-9)
    assert single.metrics["ssim"] == pytest.approx(once["metrics"]["ssim"], abs=1e-6)


def test_renders_count_as_8_bit_images(sequence: EndoscopicSequence) -> None:
    clean = renders_of(sequence, TEST)
    rng = np.random.default_rng(2)
    noisy = replace(clean, rgb=(clean.rgb + rng.normal(0, 0.1, clean.rgb.shape)).astype(np.float32))
    levels = np.rint(np.clip(noisy.rgb, 0, 1) * 255).astype(np.uint8)
    stored = replace(clean, rgb=levels.astype(np.float32) / 255)
    assert evaluate_views(noisy, sequence, TEST, None) == evaluate_views(stored, sequence, TEST, None)


def test_surface_stands_beside_the_images(sequence: EndoscopicSequence) -> None:
    errors = SurfaceErrors(0.4, 0.2, 0.5, 0.3, 0.9, 0.8, 0.85)
    surface = SurfaceResult(errors, replace(errors, recall=0.1), 0.6, 0.7, 1.0, "mesh")
    result = evaluate_views(renders_of(sequence, TEST), sequence, TEST, None, surface=surface)
    assert result.metrics["surface"]["fscore"] == 0.85
    assert result.metrics["surface"]["unobserved"]["recall"] == 0.1
    assert (result.metrics["surface"]["coverage"], result.true_surface) == (0.6, "mesh")
    assert "surface" not in result.reasons
    assert "surface" not in result.per_view[0]
    nothing = SurfaceErrors(None, None, None, None, None, 0.0, 0.0)
    surface = SurfaceResult(nothing, nothing, 0.0, 0.7, 1.0, "depth")
    result = evaluate_views(renders_of(sequence, TEST), sequence, TEST, None, surface=surface)
    assert "no surface where" in result.reasons["surface.accuracy_mm"]
    unseen = SurfaceResult(nothing, nothing, None, 0.0, 1.0, "depth")
    result = evaluate_views(renders_of(sequence, TEST), sequence, TEST, None, surface=unseen)
    assert result.reasons["surface"] == "no camera of the sequence sees the true surface"


def test_the_protocol_in_words_is_of_this_version() -> None:
    words = (Path(protocol.__file__).parent / "PROTOCOL.md").read_text()
    assert words.startswith(f"# Evaluation protocol, version {PROTOCOL_VERSION}\n")
    assert f"\n{PROTOCOL_VERSION}. " in words.split("## Versions")[1]
    assert f"smaller than {protocol.MIN_REGION_SHARE:.1%}".replace("%", " %") in words
    assert f"alpha >= {protocol.SURFACE_ALPHA}" in words
    for item in fields(SurfaceErrors):
        assert f"`{item.name}`" in words


def test_progress_is_told(sequence: EndoscopicSequence) -> None:
    events: list[Event] = []
    with subscribed(events.append):
        evaluate_views(renders_of(sequence, TEST), sequence, TEST, None)
    assert events[-1].stage == "evaluate"
    assert (events[-1].done, events[-1].total) == (2, 2)  # type: ignore[union-attr]


def test_bad_renders_are_named(sequence: EndoscopicSequence) -> None:
    renders = renders_of(sequence, TEST)
    with pytest.raises(ShapeError, match="no frame to evaluate"):
        evaluate_views(renders, sequence, np.zeros(0, dtype=np.int64), None)
    with pytest.raises(ShapeError, match="expected \\(3, 48, 64, 3\\)"):
        evaluate_views(renders, sequence, np.arange(3), None)
    renders.rgb[1, 4, 4, 0] = np.nan
    with pytest.raises(NonFiniteError, match="rendered rgb of frame 0003"):
        evaluate_views(renders, sequence, TEST, None)
    with pytest.raises((ShapeError, TypeCheckError), match=r"differ in shape|Type-check"):
        RenderedViews(renders.rgb, renders.alpha[:1], renders.depth_mm, 1)


def test_renders_survive_the_disk(sequence: EndoscopicSequence, tmp_path: Path) -> None:
    renders = renders_of(sequence, TEST)
    renders.save(tmp_path / "renders")
    again = RenderedViews.load(tmp_path / "renders")
    for name in ("rgb", "alpha", "depth_mm"):
        np.testing.assert_array_equal(getattr(again, name), getattr(renders, name))
    assert again.n_gaussians == 7
    first = evaluate_views(renders, sequence, TEST, None)
    assert isinstance(first, EvaluationResult)
    assert evaluate_views(again, sequence, TEST, None).to_json() == first.to_json()
    with pytest.raises(SourceNotFoundError, match="no renders here"):
        RenderedViews.load(tmp_path / "nothing")


def test_the_same_on_any_number_of_threads(
    sequence: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(protocol, "_PIXELS_AT_ONCE", 1)
    renders = renders_of(sequence, TEST)
    noise = np.random.default_rng(1).normal(0, 0.1, renders.rgb.shape).astype(np.float32)
    renders = replace(renders, rgb=renders.rgb + noise)
    before = torch.get_num_threads(), native.num_threads()
    found = []
    try:
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            native.set_num_threads(threads)
            found.append(evaluate_views(renders, sequence, TEST, None).to_json())
    finally:
        torch.set_num_threads(before[0])
        native.set_num_threads(before[1])
    assert found[0] == found[1] == found[2]
