"""What is looked for before a run begins, and which model a restorer's key stands for."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from extrags.config import CaptionConfig, CheckpointConfig, EnhanceConfig, PretrainedConfig
from extrags.depth.weights import hidden_digest
from extrags.errors import ConfigError, MissingDependencyError, SourceNotFoundError, WeightsError
from extrags.restoration.backends import check_restorer, restorer_digest
from extrags.restoration.pretrained.captions import URL_VARIABLE
from extrags.restoration.pretrained.checkpoint_driver import KNOWN_FAILURE
from tests.extrags.restoration.pretrained.fake_clone import write_clone
from tests.extrags.restoration.pretrained.tiny_pipelines import ADAPTERS


def pretrained(backend: str, folder: Path, **further: Any) -> EnhanceConfig:
    settings = PretrainedConfig(model=str(folder), device="cpu")
    return EnhanceConfig(backend=backend, pretrained=settings, **further)  # type: ignore[arg-type]


def checkpoint(root: Path, **further: Any) -> EnhanceConfig:
    settings = CheckpointConfig(
        root=str(root), config="configs/inference.yaml", checkpoint=str(root / "enhancer.ckpt")
    )
    return EnhanceConfig(backend="dynamicrafter", checkpoint=settings, **further)


def touch(file: Path) -> None:
    with file.open("ab") as stream:
        stream.write(b"\n")


class TestPipelines:
    @pytest.mark.parametrize("backend", sorted(ADAPTERS))
    def test_a_changed_model_has_another_digest_wherever_it_lies(
        self, backend: str, saved: Callable[[str], Path], tmp_path: Path
    ) -> None:
        folder = saved(ADAPTERS[backend].rule.pipeline)
        check_restorer(pretrained(backend, folder))
        first = restorer_digest(pretrained(backend, folder))
        assert first
        copy = tmp_path / "copy"
        shutil.copytree(folder, copy)
        assert restorer_digest(pretrained(backend, copy)) == first
        touch(next(copy.glob("scheduler/*.json")))
        assert restorer_digest(pretrained(backend, copy)) != first

    @pytest.mark.parametrize(
        ("backend", "part"),
        [
            ("wan-vace", "text_encoder/model.safetensors"),
            ("ltx", "transformer/diffusion_pytorch_model.safetensors"),
            ("stable-video", "image_encoder/model.safetensors"),
            ("sd-img2img", "vae/diffusion_pytorch_model.safetensors"),
            ("sd-inpaint", "scheduler/"),
        ],
    )
    def test_an_interrupted_download_is_told_at_once(
        self, backend: str, part: str, saved: Callable[[str], Path], tmp_path: Path
    ) -> None:
        rule = ADAPTERS[backend].rule
        folder = tmp_path / "broken"
        shutil.copytree(saved(rule.pipeline), folder)
        if part.endswith("/"):
            shutil.rmtree(folder / part)
        else:
            (folder / part).unlink()
        with pytest.raises(WeightsError) as caught:
            check_restorer(pretrained(backend, folder))
        assert f"{folder} is not whole, {part} is missing" in str(caught.value)
        assert f"Get it once with `hf download {rule.usual_model}`" in str(caught.value)

    def test_shards_are_counted(self, saved: Callable[[str], Path], tmp_path: Path) -> None:
        folder = tmp_path / "sharded"
        shutil.copytree(saved("WanVACEPipeline"), folder)
        shards = [f"diffusion_pytorch_model-0000{number}-of-00002.safetensors" for number in (1, 2)]
        whole = folder / "transformer" / "diffusion_pytorch_model.safetensors"
        whole.rename(whole.with_name(shards[0]))
        index = whole.with_name(f"{whole.name}.index.json")
        index.write_text(json.dumps({"weight_map": dict(zip("ab", shards, strict=True))}))
        with pytest.raises(WeightsError, match=f"transformer/{shards[1]} is missing"):
            check_restorer(pretrained("wan-vace", folder))
        shutil.copy(whole.with_name(shards[0]), whole.with_name(shards[1]))
        check_restorer(pretrained("wan-vace", folder))
        os.truncate(whole.with_name(shards[1]), 2000)
        with pytest.raises(WeightsError, match=f"transformer/{shards[1]} is cut short"):
            check_restorer(pretrained("wan-vace", folder))
        index.write_text("{}")
        with pytest.raises(WeightsError, match=r"safetensors\.index\.json is damaged"):
            check_restorer(pretrained("wan-vace", folder))

    @pytest.mark.parametrize(
        "content",
        [
            b"",
            b"1234567",
            b"version https://git-lfs.github.com/spec/v1\n",
            bytes(8),
            b"\2" + bytes(7) + b"[]",
        ],
        ids=["empty", "seven-bytes", "git-lfs", "no-header", "no-mapping"],
    )
    def test_what_is_no_file_of_weights(
        self, content: bytes, saved: Callable[[str], Path], tmp_path: Path
    ) -> None:
        folder = tmp_path / "other"
        shutil.copytree(saved("StableDiffusionImg2ImgPipeline"), folder)
        (folder / "vae" / "diffusion_pytorch_model.safetensors").write_bytes(content)
        with pytest.raises(
            WeightsError, match=r"vae/diffusion_pytorch_model\.safetensors is cut short or no"
        ):
            check_restorer(pretrained("sd-img2img", folder))

    def test_settings_that_do_not_fit_are_told_before_the_model_is_looked_for(self, tmp_path: Path) -> None:
        settings = PretrainedConfig(model=str(tmp_path / "none"), frames=16)
        with pytest.raises(ConfigError, match=r"takes 4k\+1 frames"):
            check_restorer(EnhanceConfig(backend="wan-vace", pretrained=settings))
        settings = PretrainedConfig(model=str(tmp_path / "none"), device="cpu", offload="model")
        with pytest.raises(ConfigError, match="offload=model"):
            check_restorer(EnhanceConfig(backend="wan-vace", pretrained=settings))


class TestTexts:
    def test_their_file_is_part_of_the_model(self, saved: Callable[[str], Path], tmp_path: Path) -> None:
        file = tmp_path / "texts.yaml"
        caption = CaptionConfig(source="file", file=str(file))
        config = pretrained("wan-vace", saved("WanVACEPipeline"), caption=caption)
        for look in (check_restorer, restorer_digest):
            with pytest.raises(SourceNotFoundError, match=r"texts\.yaml"):
                look(config)
        digests = set()
        for text in ("a: pink", "a: pale"):
            file.write_text(text)
            check_restorer(config)
            digests.add(restorer_digest(config))
        assert len(digests) == 2
        # This one reads no text.
        silent = pretrained("stable-video", saved("StableVideoDiffusionPipeline"))
        told = silent.model_copy(update={"caption": caption})
        assert restorer_digest(told) == restorer_digest(silent)

    def test_an_endpoint_without_address_is_told(
        self, saved: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.delenv(URL_VARIABLE, raising=False)
        caption = CaptionConfig(source="endpoint", model="seer-1")
        with pytest.raises(ConfigError, match=f"needs the server's address in {URL_VARIABLE}"):
            check_restorer(pretrained("ltx", saved("LTXConditionPipeline"), caption=caption))


class TestCheckpoint:
    def test_checkpoint_config_and_code_make_the_model(self, tmp_path: Path) -> None:
        root = write_clone(tmp_path / "clone")
        digests = {restorer_digest(checkpoint(root))}
        moved = tmp_path / "moved"
        shutil.copytree(root, moved)
        assert restorer_digest(checkpoint(moved)) in digests
        for part in ("enhancer.ckpt", "configs/inference.yaml", "lvdm/models/samplers/ddim.py"):
            touch(root / part)
            digests.add(restorer_digest(checkpoint(root)))
        assert len(digests) == 4

    def test_the_interpreter_is_tried_at_once(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Here an interpreter that only says what the driver would; a real one lacks a package elsewhere."""
        root = write_clone(tmp_path / "clone")

        def lacking(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
            assert "--check" in command
            told = {"kind": "dependency", "message": "the clone needs something"}
            Path(f"{command[-1]}.json").write_text(json.dumps(told))
            return subprocess.CompletedProcess(command, KNOWN_FAILURE, "", "")

        monkeypatch.setattr(subprocess, "run", lacking)
        with pytest.raises(MissingDependencyError, match="the clone needs something"):
            check_restorer(checkpoint(root))


class TestOwn:
    def test_something_has_to_restore(self) -> None:
        untrained = EnhanceConfig(pretrained_weights="none").model_copy(update={"train_iterations": 0})
        with pytest.raises(ConfigError, match="nothing would restore"):
            check_restorer(untrained)

    def test_nothing_is_needed_for_the_classical_fill(self) -> None:
        config = EnhanceConfig(backend="classical", pretrained_weights="no/such/file")
        check_restorer(config)
        assert restorer_digest(config) is None

    def test_weights_of_the_embedded_one(self, tmp_path: Path) -> None:
        missing = EnhanceConfig(pretrained_weights=str(tmp_path / "mine.safetensors"))
        for look in (check_restorer, restorer_digest):
            with pytest.raises(WeightsError, match=r"there is no file .*mine\.safetensors"):
                look(missing)
        (tmp_path / "mine.safetensors").write_bytes(b"weights")
        (tmp_path / "mine.json").write_text("{}")
        assert restorer_digest(missing)
        with pytest.raises(WeightsError, match=r"mine\.json: format None"):
            check_restorer(missing)
        alone = EnhanceConfig(pretrained_weights="none")
        guessing = alone.model_copy(update={"depth_from_image": False})
        assert restorer_digest(guessing) is None
        # What reads depth counts too: cached views follow its weights.
        assert hidden_digest() in str(restorer_digest(alone))
