"""What a restorer needs that may not be there, told before anything runs, and which model it is."""

from __future__ import annotations

import hashlib

from extrags.config import EnhanceConfig
from extrags.restoration.backends import starting_restorer
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.weights import weights_digest
from extrags.restoration.pretrained.captions import check_source
from extrags.restoration.pretrained.checkpoint import CheckpointEnhancer, check_interpreter, clone_fingerprint
from extrags.restoration.pretrained.enhancer import ADAPTERS, check_pipeline
from extrags.restoration.pretrained.fingerprint import files_fingerprint, fingerprint

__all__ = ["check_restorer", "model_digest"]


def check_restorer(config: EnhanceConfig) -> None:
    """Look for everything that the backend needs besides the scene.

    A model that may be downloaded (`enhance.pretrained.local_files_only=false`) is downloaded here.

    Args:
        config: backend, model and caption.

    Raises:
        WeightsError: when weights are not there, or do not fit; says how to get them.
        MissingDependencyError: when a package is not there; says how to install it.
        ConfigError: when settings do not fit each other, the model or the machine.
        SourceNotFoundError: when the file of captions is not there.
        ExtragsError: when the clone of a checkpoint's code does not start.
    """
    if _reads_text(config):
        check_source(config.caption)
    if config.backend == EmbeddedEnhancer.name:
        # A few megabytes are loaded: whether they fit this version shows at once.
        starting_restorer(config)
    elif config.backend == CheckpointEnhancer.name:
        check_interpreter(config.checkpoint)
    elif config.backend in ADAPTERS:
        check_pipeline(config)


def model_digest(config: EnhanceConfig) -> str | None:
    """Digest of what others trained and the restorer starts from: weights, code, texts.

    Where they lie is not in it. A scene's restorer prepared with another digest is another restorer.

    Args:
        config: backend, model and caption.

    Returns:
        None for a backend that starts from nothing.

    Raises:
        ExtragsError: as `check_restorer`.
    """
    if config.backend == EmbeddedEnhancer.name:
        return weights_digest(config.pretrained_weights)
    if config.backend == CheckpointEnhancer.name:
        model = clone_fingerprint(config.checkpoint)
    elif config.backend in ADAPTERS:
        model = fingerprint(check_pipeline(config))
    else:
        return None
    texts = check_source(config.caption) if _reads_text(config) else None
    if texts is None:
        return model
    parts = f"{model} {files_fingerprint({'texts': texts})}"
    return hashlib.blake2b(parts.encode(), digest_size=16).hexdigest()


def _reads_text(config: EnhanceConfig) -> bool:
    if config.backend in ADAPTERS:
        return bool(ADAPTERS[config.backend].rule.text_parts)
    return config.backend == CheckpointEnhancer.name
