"""Runs a DynamiCrafter-type model inside the user's own clone of its code.

Started as a script, in a process of its own, perhaps by another interpreter: nothing of extrags is
imported here, and the syntax is that of Python 3.8. It reads one .npz and writes one:

    request: `settings` (JSON), `frames` [W, T, 3, H, W] in [0, 1], `unknown` [W, T, 1, H, W] (1 where
        nothing is known), `poses` [W, T, 4, 4] relative to the first frame, `seeds` [W]
    result: `frames` [W, T, 3, H, W] in [0, 1]

or, after a known failure, a .json `{kind, message}` in the result's place and exit code 2.
With `--check` it only imports the clone's modules.
"""

from __future__ import annotations

import importlib
import json
import os
import pickle
import sys
from typing import Any

KNOWN_FAILURE = 2
MODULES = ("torch", "numpy", "omegaconf", "utils.utils", "lvdm.models.samplers.ddim")


class Failure(Exception):
    """A failure the user can mend; `kind` is weights, dependency or config."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def main(arguments: list[str]) -> int:
    """Run one request; returns the exit code."""
    request, result = arguments[-2:]
    # This file's own folder holds modules of extrags that must not be taken for the clone's.
    sys.path[:] = [path for path in sys.path if os.path.abspath(path or ".") != _here()]
    try:
        settings = _settings(request)
        sys.path.insert(0, settings["root"])
        os.chdir(settings["root"])
        _import_all(settings)
        if "--check" not in arguments:
            _run(settings, request, result)
    except Failure as failure:
        with open(result + ".json", "w") as stream:
            json.dump({"kind": failure.kind, "message": str(failure)}, stream)
        return KNOWN_FAILURE
    return 0


def _here() -> str:
    return os.path.dirname(os.path.abspath(__file__))


def _settings(request: str) -> Any:
    import numpy

    with numpy.load(request, allow_pickle=False) as archive:
        return json.loads(str(archive["settings"]))


def _import_all(settings: Any) -> None:
    target = settings["target"].rsplit(".", 1)[0]
    for name in (*MODULES, target):
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise Failure(
                "dependency",
                f"the clone {settings['root']} needs {name}, which {sys.executable} cannot import: {error}",
            ) from error


def _run(settings: Any, request: str, result: str) -> None:
    import numpy
    import torch

    with numpy.load(request, allow_pickle=False) as archive:
        frames, unknown, poses = (torch.from_numpy(archive[name]) for name in ("frames", "unknown", "poses"))
        seeds = archive["seeds"].tolist()
    torch.set_num_threads(settings["threads"])
    device = torch.device(_device(settings["device"], torch))
    model, half = _model(settings, device, torch)
    restore = _enhanced if settings["interface"] == "enhancer" else _inpainted
    restored = []
    for window, seed in enumerate(seeds):
        torch.manual_seed(seed)
        with torch.no_grad(), torch.autocast(device.type, enabled=half and device.type == "cuda"):
            images = restore(
                model,
                frames[window].to(device),
                unknown[window].to(device),
                poses[window].to(device),
                settings,
                torch,
            )
        restored.append(images.float().clamp(0, 1).cpu().numpy())
    with open(result, "wb") as stream:
        numpy.savez(stream, frames=numpy.stack(restored))


def _device(name: str, torch: Any) -> str:
    if name != "auto":
        return name
    return "cuda" if torch.cuda.is_available() else "cpu"


def _model(settings: Any, device: Any, torch: Any) -> tuple[Any, bool]:
    config = importlib.import_module("omegaconf").OmegaConf.load(settings["config"])
    description = config["model"]
    parameters = description["params"]
    if "unet_config" in parameters:
        parameters["unet_config"]["params"]["use_checkpoint"] = False
    for encoder in ("cond_stage_config", "img_cond_stage_config"):
        # OpenCLIP would download weights here that the checkpoint then overwrites.
        if encoder in parameters and "OpenCLIP" in str(parameters[encoder].get("target", "")):
            if "params" not in parameters[encoder]:
                parameters[encoder]["params"] = {}
            parameters[encoder]["params"]["version"] = None
    model = importlib.import_module("utils.utils").instantiate_from_config(description)
    _load(model, settings, torch)
    model = model.to(device).eval()
    model.perframe_ae = settings["interface"] == "dynamicrafter"
    precision = config.get("lightning", {}).get("precision", 32)
    return model, str(precision).startswith("16")


def _load(model: Any, settings: Any, torch: Any) -> None:
    file = settings["checkpoint"]
    weights = _weights(file, settings["trust_pickle"], torch)
    try:
        model.load_state_dict(weights, strict=True)
    except RuntimeError as error:
        raise Failure("weights", f"{file} does not fit {settings['config']}: {error}") from error


def _weights(file: str, trust_pickle: bool, torch: Any) -> Any:
    if file.endswith(".safetensors"):
        from safetensors.torch import load_file

        return load_file(file)
    content = _content(file, trust_pickle, torch)
    if "state_dict" in content:
        return content["state_dict"]
    if "module" in content:
        # DeepSpeed puts a prefix before every name.
        prefix = "_forward_module."
        return {
            name[len(prefix) :] if name.startswith(prefix) else name: value
            for name, value in content["module"].items()
        }
    return content


def _content(file: str, trust_pickle: bool, torch: Any) -> Any:
    refused = (pickle.UnpicklingError, TypeError)
    damaged = (RuntimeError, EOFError, OSError)
    try:
        return torch.load(file, map_location="cpu", weights_only=True)
    except refused as error:
        if not trust_pickle:
            raise Failure(
                "weights",
                f"{file} was not loaded: it holds more than tensors (or is damaged), and unpickling it may "
                "run any code. If you trust where it came from, set enhance.checkpoint.trust_pickle=true "
                f"({str(error).splitlines()[0]})",
            ) from error
    except damaged as error:
        raise Failure("weights", f"{file} is not a readable checkpoint: {error}") from error
    try:
        return torch.load(file, map_location="cpu", weights_only=False)
    except (*refused, *damaged) as error:
        raise Failure("weights", f"{file} is not a readable checkpoint: {error}") from error


def _enhanced(model: Any, frames: Any, unknown: Any, poses: Any, settings: Any, torch: Any) -> Any:
    """The paper's enhancer: renders and their uncertainty in, clean frames out."""
    video = frames.permute(1, 0, 2, 3)[None]
    guidance = unknown.permute(1, 0, 2, 3)
    batch = {
        "renders": video,
        "video": video,
        "caption": [settings["caption"]],
        "cond_frame_idx": [0],
        "camera_pose": poses[:, :3].reshape(1, len(poses), 12),
        "fps": torch.tensor([settings["fps"]]),
        "guidance": guidance,
    }
    log = model.log_images(
        batch,
        sample=True,
        ddim_steps=settings["steps"],
        ddim_eta=settings["eta"],
        plot_denoise_rows=False,
        unconditional_guidance_scale=settings["guidance_scale"],
        mask=None,
        renders=frames,
        cond_frame_idx=[0],
        render_pose=poses,
        guidance=guidance,
    )
    return log["samples"][0].permute(1, 0, 2, 3)


def _inpainted(model: Any, frames: Any, unknown: Any, poses: Any, settings: Any, torch: Any) -> Any:
    """The published image-to-video model: the real view animated, known latents held at every step.

    It was never trained to restore renders; the mask is what keeps it to the scene.
    """
    sampler_class = importlib.import_module("lvdm.models.samplers.ddim").DDIMSampler
    video = (2 * frames - 1).permute(1, 0, 2, 3)[None]
    image = video[:, :, 0]
    latents = model.encode_first_stage(video)
    text = model.get_learned_conditioning([settings["caption"]])
    seen = model.image_proj_model(model.embedder(image))
    condition = {"c_crossattn": [torch.cat([text, seen], dim=1)], "c_concat": [_first(latents)]}
    without = None
    scale = settings["guidance_scale"]
    if scale != 1:
        nothing = model.image_proj_model(model.embedder(torch.zeros_like(image)))
        empty = (
            model.get_learned_conditioning([""])
            if model.uncond_type == "empty_seq"
            else torch.zeros_like(text)
        )
        without = {"c_crossattn": [torch.cat([empty, nothing], dim=1)], "c_concat": [_first(latents)]}
    holes = torch.nn.functional.adaptive_max_pool2d(unknown, latents.shape[-2:])
    samples, _ = sampler_class(model).sample(
        S=settings["steps"],
        conditioning=condition,
        batch_size=1,
        shape=tuple(latents.shape[1:]),
        verbose=False,
        unconditional_guidance_scale=scale,
        unconditional_conditioning=without,
        eta=settings["eta"],
        mask=(1 - holes).permute(1, 0, 2, 3)[None],
        x0=latents,
        fs=torch.tensor([settings["fps"]], device=frames.device),
        timestep_spacing="uniform_trailing",
        guidance_rescale=0.7,
    )
    return (model.decode_first_stage(samples)[0].permute(1, 0, 2, 3) + 1) / 2


def _first(latents: Any) -> Any:
    return latents[:, :, :1].expand(-1, -1, latents.shape[2], -1, -1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
