"""What every restorer backend has to do: a new entry of BACKENDS is tested here without a line of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.config import (
    CaptionConfig,
    CheckpointConfig,
    CoarseConfig,
    DensifyConfig,
    EnhanceConfig,
    PipelineConfig,
    PretrainedConfig,
)
from extrags.config.backends import BACKENDS
from extrags.errors import ConfigError, WeightsError
from extrags.restoration.backends import (
    backend_of,
    check_restorer,
    load_enhancer,
    register_backend,
    restorer_digest,
    train_enhancer,
)
from extrags.restoration.benchmark.comparison import check_methods, prepared
from extrags.restoration.classical import ClassicalBackend, ClassicalEnhancer
from extrags.restoration.clips import render_clips
from extrags.restoration.description import DESCRIPTION, read_description, write_description
from extrags.restoration.pretrained import enhancer as pipelines
from extrags.restoration.pretrained.enhancer import DiffusersBackend
from extrags.restoration.protocol import Backend, Clip, Enhancer, Restoration
from tests.extrags.lit_tube import HEIGHT, WIDTH, Tube, tube_cameras
from tests.extrags.restoration.pretrained.fake_clone import write_clone

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
]

COARSE = CoarseConfig(max_points=400, densify=DensifyConfig(enabled=False))


@dataclass(frozen=True)
class Case:
    """A backend with settings that are as small as it can do with, and its restorer of the tube."""

    name: str
    config: EnhanceConfig
    enhancer: Enhancer
    clip: Clip
    restoration: Restoration


@pytest.fixture(scope="module")
def clip(tube: Tube) -> Clip:
    cameras = tube_cameras(6, offset_mm=4.0)
    return render_clips(tube.scene, tube.references, [cameras], count=4, first_index=3)[0]


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clone(tmp_path_factory.mktemp("clone"))


@pytest.fixture(scope="module", params=BACKENDS)
def case(
    request: pytest.FixtureRequest, tube: Tube, clip: Clip, saved: Callable[[str], Path], clone: Path
) -> Case:
    """Everything is in place for the backend; the embedded one stands whatever the tube says."""
    name: str = request.param
    backend = backend_of(name)
    small = EnhanceConfig(backend=name, folds=1, fold_iterations=5, references=4, judge=False, seed=4)
    parts: dict[str, object] = {}
    if isinstance(backend, DiffusersBackend):
        rule = backend.adapter.rule
        # Several windows: the clip is longer than one.
        frames = 1 + 4 * max(1, rule.frame_step // 4)
        parts["pretrained"] = PretrainedConfig(
            model=str(saved(rule.pipeline)),
            device="cpu",
            short_side_px=32,
            steps=2,
            strength=1.0,
            frames=frames,
            overlap=2,
        )
    parts["checkpoint"] = CheckpointConfig(
        root=str(clone),
        config="configs/inference.yaml",
        checkpoint=str(clone / "enhancer.ckpt"),
        frames=4,
        overlap=1,
        width=64,
        height=32,
        device="cpu",
    )
    config = small.model_copy(update=parts)
    enhancer = train_enhancer(tube.scene, tube.sequence, config, COARSE)
    return Case(name, config, enhancer, clip, enhancer.restore(clip))


class TestEveryBackend:
    def test_it_has_the_protocol_and_its_name(self, case: Case) -> None:
        backend = backend_of(case.name)
        assert isinstance(backend, Backend)
        assert isinstance(case.enhancer, Enhancer)
        assert backend.name == case.enhancer.name == case.name
        summary = BACKENDS[case.name].summary
        assert summary
        assert len(summary) < 60
        assert "\n" not in summary

    def test_what_it_needs_is_found(self, case: Case) -> None:
        check_restorer(case.config)

    def test_its_digest_is_that_of_a_model(self, case: Case) -> None:
        backend = backend_of(case.name)
        digest = backend.digest(case.config)
        assert digest is None or len(digest) >= 16
        # The key of a restorer must not depend on anything else.
        elsewhere = case.config.model_copy(update={"seed": 9, "max_views": 3})
        assert restorer_digest(case.config) == restorer_digest(elsewhere) == digest

    def test_texts_count_where_they_are_read(self, case: Case, tmp_path: Path) -> None:
        digests = set()
        for text in ("a: pink", "a: pale"):
            file = tmp_path / "texts.yaml"
            file.write_text(text)
            caption = CaptionConfig(source="file", file=str(file))
            digests.add(restorer_digest(case.config.model_copy(update={"caption": caption})))
        assert len(digests) == (2 if backend_of(case.name).needs_text(case.config) else 1)

    def test_the_endpoint_of_captions_counts_without_its_credentials(
        self, case: Case, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        asking = CaptionConfig(source="endpoint", model="seer-1")
        config = case.config.model_copy(update={"caption": asking})
        digests = []
        for url in ("https://a:one@host/v1", "https://a:two@host/v1/", "https://other/v1"):
            monkeypatch.setenv("EXTRAGS_CAPTION_URL", url)
            digests.append(restorer_digest(config))
        assert digests[0] == digests[1]
        assert (digests[1] != digests[2]) == backend_of(case.name).needs_text(config)

    def test_restored_views_are_images(self, case: Case) -> None:
        found = case.restoration
        assert found.rgb.shape == (len(case.clip), HEIGHT, WIDTH, 3)
        assert found.rgb.dtype == np.float32
        assert found.rgb.min() >= 0
        assert found.rgb.max() <= 1
        assert found.rgb.std() > 0.01
        for planes in (found.expected_error, found.depth_mm):
            if planes is not None:
                assert planes.shape == found.rgb.shape[:3]
                assert planes.min() > 0
                assert np.isfinite(planes).all()

    def test_its_provenance_is_json(self, case: Case) -> None:
        provenance = case.restoration.provenance
        assert provenance["backend"] == case.name
        assert json.loads(json.dumps(provenance, allow_nan=False)) == provenance

    def test_saved_and_loaded_it_restores_the_same(self, case: Case, tmp_path: Path) -> None:
        before = case.clip.layers.data.clone()
        case.enhancer.save(tmp_path / "first")
        # Pipelines stay open between clips; this one is read from disk.
        pipelines._OPEN.clear()
        loaded = load_enhancer(tmp_path / "first")
        assert isinstance(loaded, type(case.enhancer))
        again = loaded.restore(case.clip)
        assert np.array_equal(again.rgb, case.restoration.rgb)
        assert again.provenance == case.restoration.provenance
        assert torch.equal(case.clip.layers.data, before)
        loaded.save(tmp_path / "second")
        for first in (path for path in (tmp_path / "first").rglob("*") if path.is_file()):
            second = tmp_path / "second" / first.relative_to(tmp_path / "first")
            assert second.read_bytes() == first.read_bytes()

    @pytest.mark.parametrize("content", ["", "{", "[1]", "{}", '{"backend": "magic"}', "\xff"])
    def test_a_damaged_description_is_named(self, case: Case, tmp_path: Path, content: str) -> None:
        case.enhancer.save(tmp_path)
        file = tmp_path / "restorer.json"
        file.write_text(content, encoding="latin-1")
        with pytest.raises(WeightsError, match=rf"^{file}: "):
            load_enhancer(tmp_path)

    def test_a_description_without_one_of_its_entries_is_named(self, case: Case, tmp_path: Path) -> None:
        case.enhancer.save(tmp_path)
        file = tmp_path / "restorer.json"
        description = json.loads(file.read_text())
        for name in description:
            file.write_text(json.dumps({key: value for key, value in description.items() if key != name}))
            with pytest.raises(WeightsError, match=rf"^{file}: "):
                load_enhancer(tmp_path)

    def test_without_a_description_it_says_what_to_do(self, case: Case, tmp_path: Path) -> None:
        case.enhancer.save(tmp_path)
        (tmp_path / "restorer.json").unlink()
        with pytest.raises(
            WeightsError, match=rf"{tmp_path}/restorer\.json: no such file; train the restorer first"
        ):
            load_enhancer(tmp_path)


class Darkened(ClassicalBackend):
    """A backend as another program would write it."""

    name = "darkened"

    def prepare(self, *_: object) -> DarkenedEnhancer:
        return DarkenedEnhancer()

    def load(self, path: Path) -> DarkenedEnhancer:
        return DarkenedEnhancer()


class DarkenedEnhancer:
    name = Darkened.name

    def restore(self, clip: Clip) -> Restoration:
        return Restoration(0.5 * ClassicalEnhancer().restore(clip).rgb, None, {"backend": self.name})

    def save(self, path: Path) -> None:
        path.mkdir(parents=True, exist_ok=True)
        (path / "restorer.json").write_text(json.dumps({"backend": self.name}))


@pytest.fixture
def registered() -> Iterator[Backend]:
    before = dict(BACKENDS)
    backend = Darkened()
    register_backend(backend, "half as bright")
    yield backend
    BACKENDS.clear()
    BACKENDS.update(before)


class TestRegistration:
    def test_from_settings_to_restored_views(
        self, registered: Backend, tube: Tube, clip: Clip, tmp_path: Path
    ) -> None:
        config = PipelineConfig().with_overrides({"enhance.backend": "darkened"}).enhance
        check_restorer(config)
        train_enhancer(tube.scene, tube.sequence, config, COARSE).save(tmp_path)
        restored = load_enhancer(tmp_path).restore(clip).rgb
        np.testing.assert_array_equal(restored, 0.5 * ClassicalEnhancer().restore(clip).rgb)

    def test_it_is_a_method_of_the_benchmark(self, registered: Backend, tube: Tube) -> None:
        assert check_methods(["darkened"]) == ["darkened"]
        ((_, enhancer, _),) = prepared(["darkened"], tube.scene, tube.sequence, EnhanceConfig(), COARSE)
        assert isinstance(enhancer, DarkenedEnhancer)

    @pytest.mark.usefixtures("registered")
    def test_the_schema_lists_it(self) -> None:
        schema = EnhanceConfig.model_json_schema()["properties"]["backend"]
        assert schema["enum"] == list(BACKENDS)
        assert schema["description"].endswith("darkened: half as bright")

    def test_its_version_is_part_of_the_digest(self, registered: Backend) -> None:
        config = EnhanceConfig(backend=registered.name)
        first = restorer_digest(config)
        assert first is not None
        del BACKENDS[registered.name]
        register_backend(registered, "half as bright", version=2)
        assert restorer_digest(config) not in (first, None)
        with pytest.raises(ConfigError, match="version 0 of the restorer backend"):
            register_backend(Darkened(), "again", version=0)

    @pytest.mark.usefixtures("registered")
    def test_a_name_is_given_once(self) -> None:
        with pytest.raises(ConfigError, match="there is a restorer backend darkened already"):
            register_backend(Darkened(), "again")
        with pytest.raises(ConfigError, match="there is a restorer backend classical already"):
            register_backend(ClassicalBackend(), "mine")

    def test_half_a_backend_is_refused(self) -> None:
        class Half:
            name = "half"

            def check(self, config: EnhanceConfig) -> None: ...

        with pytest.raises(ConfigError, match="Half is no restorer backend: it lacks digest, needs_text"):
            register_backend(Half(), "half of one")


class TestNames:
    def test_a_misspelt_name_is_refused_with_the_nearest(self) -> None:
        names = list(BACKENDS)
        with pytest.raises(ConfigError) as caught:
            PipelineConfig().with_overrides({"enhance.backend": "clasical"})
        assert str(caught.value) == (
            f"setting enhance.backend is 'clasical'; expected {', '.join(names[:-1])} or {names[-1]}; "
            "did you mean classical?"
        )
        for refused in (backend_of, lambda name: EnhanceConfig(backend=name)):
            with pytest.raises(ValueError, match=r"clasical is none of embedded.*; did you mean classical\?"):
                refused("clasical")

    def test_looking_names_up_loads_nothing(self) -> None:
        """Settings are read by commands that must answer at once."""
        code = (
            "import sys, extrags.restoration as r; from extrags.config import EnhanceConfig;"
            "assert 'ltx' in r.BACKENDS; EnhanceConfig(backend='ltx').model_json_schema();"
            "assert not {'torch', 'diffusers', 'transformers'} & set(sys.modules);"
            "[r.backend_of(name) for name in r.BACKENDS];"
            "assert not {'diffusers', 'transformers'} & set(sys.modules)"
        )
        subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_a_description_that_cannot_be_written_leaves_the_older_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_description(tmp_path, {"backend": "older"})

    def full(path: Path, content: bytes) -> int:
        with path.open("wb") as file:
            file.write(content[:5])
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="no space left"):
        write_description(tmp_path, {"backend": "newer"})
    assert read_description(tmp_path / DESCRIPTION) == {"backend": "older"}
    assert len(list(tmp_path.iterdir())) == 1
