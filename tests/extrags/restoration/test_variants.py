from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.errors import CaptureError, ConfigError
from extrags.restoration.benchmark.evaluation import held_out_clips
from extrags.restoration.benchmark.variants import AsRendered, Textured, WithoutReferences
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.protocol import Clip
from extrags.restoration.surface_texture import invented_share
from extrags.restoration.training_data.augmentation import drop_references, unconfirmed
from extrags.view_synthesis.conditioning import Layers
from tests.extrags.lit_tube import Tube


@pytest.fixture(scope="module")
def clip(tube: Tube) -> Clip:
    clips = held_out_clips(tube.scene, tube.references, tube.sequence, tube.sequence.test, count=4)
    return clips[0]


class TestWithoutReferences:
    def test_only_the_references_go(self, clip: Clip) -> None:
        before = clip.layers.data.clone()
        alone = WithoutReferences(ClassicalEnhancer())
        assert alone.name == "classical/no-references"
        restored = alone.restore(clip)
        assert torch.equal(clip.layers.data, before)
        expected = ClassicalEnhancer().restore(replace(clip, layers=drop_references(Layers(before.clone()))))
        assert np.array_equal(restored.rgb, expected.rgb)
        assert not np.array_equal(restored.rgb, ClassicalEnhancer().restore(clip).rgb)
        assert restored.provenance == {"backend": "classical", "references": False}

    def test_saving(self, tmp_path) -> None:
        WithoutReferences(ClassicalEnhancer()).save(tmp_path)
        assert (tmp_path / "restorer.json").exists()
        with pytest.raises(ConfigError, match="cannot be saved"):
            AsRendered().save(tmp_path)


class TestTextured:
    def test_only_what_is_invented_changes(self, tube: Tube, clip: Clip) -> None:
        plain = ClassicalEnhancer().restore(clip)
        textured = Textured.of_references(ClassicalEnhancer(), tube.references, seed=1).restore(clip)
        assert textured.provenance == {**plain.provenance, "textured": True, "refined": False}
        changed = np.abs(textured.rgb - plain.rgb).max(axis=-1) > 1e-6
        invented = invented_share(unconfirmed(clip.layers)[:, 0]).numpy()
        assert changed[invented > 0].mean() > 0.5
        assert not changed[invented == 0].any()
        assert (invented == 0).mean() > 0.2

    def test_a_seed_is_a_texture(self, tube: Tube, clip: Clip) -> None:
        first, same, other = (
            Textured.of_references(ClassicalEnhancer(), tube.references, seed=seed).restore(clip).rgb
            for seed in (1, 1, 2)
        )
        assert np.array_equal(first, same)
        assert not np.array_equal(first, other)

    def test_there_must_be_texture(self, tube: Tube) -> None:
        packed = tube.references.packed.clone()
        packed[:, 5] = 0
        with pytest.raises(CaptureError, match="no frame shows the surface"):
            Textured.of_references(ClassicalEnhancer(), replace(tube.references, packed=packed))
