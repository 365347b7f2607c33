"""A clone of DynamiCrafter's layout with a tiny random model, written by the tests.

Only names, shapes and call signatures are those of the published code; what is inside is ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import yaml
from torch import nn

OMEGACONF = """
import yaml


class Node(dict):
    def __getattr__(self, name):
        return self[name]


def _nodes(value):
    if isinstance(value, dict):
        return Node({name: _nodes(item) for name, item in value.items()})
    return [_nodes(item) for item in value] if isinstance(value, list) else value


class OmegaConf:
    @staticmethod
    def load(path):
        with open(path) as stream:
            return _nodes(yaml.safe_load(stream))
"""

INSTANTIATE = """
import importlib


def instantiate_from_config(config):
    module, name = config["target"].rsplit(".", 1)
    return getattr(importlib.import_module(module), name)(**config.get("params", {}))
"""

MODEL = """
import json

import torch
from torch import nn


class LatentVisualDiffusion(nn.Module):
    uncond_type = "empty_seq"

    def __init__(self, width, unet_config, cond_stage_config):
        super().__init__()
        self.told = {"use_checkpoint": unet_config["params"]["use_checkpoint"],
                     "version": cond_stage_config["params"]["version"]}
        self.mix = nn.Conv3d(3, 3, 3, padding=1)
        self.encoder = nn.Conv2d(3, width, 8, stride=8)
        self.decoder = nn.ConvTranspose2d(width, 3, 8, stride=8)
        self.words = nn.Embedding(8, 6)

    def log_images(self, batch, sample, ddim_steps, ddim_eta, plot_denoise_rows,
                   unconditional_guidance_scale, mask, **rest):
        seen = {name: list(value.shape) for name, value in batch.items() if isinstance(value, torch.Tensor)}
        seen.update(self.told, caption=batch["caption"], fps=int(batch["fps"][0]), steps=ddim_steps,
                    eta=ddim_eta, scale=unconditional_guidance_scale, cond=batch["cond_frame_idx"],
                    perframe=self.perframe_ae, rest=sorted(rest),
                    first_pose=batch["camera_pose"][0, 0].tolist(),
                    lead_uncertainty=float(batch["guidance"][:, 0].max()))
        with open("seen.json", "w") as stream:
            json.dump(seen, stream)
        if "crash" in batch["caption"][0]:
            raise RuntimeError("the fake model was told to crash")
        video = batch["video"]
        return {"samples": video + 0.1 * torch.tanh(self.mix(video)) + 0.02 * torch.randn_like(video)}

    def encode_first_stage(self, video):
        return torch.stack([self.encoder(frame) for frame in video.unbind(2)], 2)

    def decode_first_stage(self, latents):
        return torch.stack([torch.tanh(self.decoder(frame)) for frame in latents.unbind(2)], 2)

    def get_learned_conditioning(self, prompts):
        return self.words(torch.tensor([[len(prompt) % 8] for prompt in prompts]))

    def embedder(self, image):
        return image.mean(dim=(2, 3))[:, None]

    def image_proj_model(self, tokens):
        return tokens.repeat(1, 1, 2)
"""

SAMPLER = """
import torch


class DDIMSampler:
    def __init__(self, model):
        self.model = model

    def sample(self, S, conditioning, batch_size, shape, verbose, unconditional_guidance_scale,
               unconditional_conditioning, eta, mask, x0, fs, timestep_spacing, guidance_rescale):
        assert conditioning["c_crossattn"][0].shape[-1] == 6
        assert conditioning["c_concat"][0].shape == x0.shape
        assert unconditional_conditioning is not None and unconditional_guidance_scale == 7.5
        assert mask.shape[-3:] == x0.shape[-3:]
        noise = torch.randn((batch_size, *shape))
        return x0 * mask + (1 - mask) * noise, {}
"""


def tiny_state() -> dict[str, torch.Tensor]:
    """Weights that fit the fake model."""
    torch.manual_seed(3)
    parts = {
        "mix": nn.Conv3d(3, 3, 3, padding=1),
        "encoder": nn.Conv2d(3, 4, 8, stride=8),
        "decoder": nn.ConvTranspose2d(4, 3, 8, stride=8),
        "words": nn.Embedding(8, 6),
    }
    return {
        f"{part}.{name}": value
        for part, module in parts.items()
        for name, value in module.state_dict().items()
    }


def write_clone(root: Path, *, needs: str = "") -> Path:
    """Write the clone, its config and its checkpoint; returns the root.

    Args:
        root: new folder.
        needs: a package that the model's module imports.
    """
    files = {
        "omegaconf.py": OMEGACONF,
        "utils/__init__.py": "",
        "utils/utils.py": INSTANTIATE,
        "lvdm/__init__.py": "",
        "lvdm/models/__init__.py": "",
        "lvdm/models/ddpm3d.py": (f"import {needs}\n" if needs else "") + MODEL,
        "lvdm/models/samplers/__init__.py": "",
        "lvdm/models/samplers/ddim.py": SAMPLER,
    }
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    config: dict[str, Any] = {
        "model": {
            "target": "lvdm.models.ddpm3d.LatentVisualDiffusion",
            "params": {
                "width": 4,
                "unet_config": {"params": {"use_checkpoint": True}},
                "cond_stage_config": {"target": "lvdm.modules.FrozenOpenCLIPEmbedder"},
            },
        },
        "lightning": {"precision": 16},
    }
    (root / "configs").mkdir()
    (root / "configs" / "inference.yaml").write_text(yaml.safe_dump(config))
    torch.save({"state_dict": tiny_state()}, root / "enhancer.ckpt")
    return root
