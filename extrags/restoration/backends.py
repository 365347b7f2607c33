"""Restorers by the name of their backend: registered, checked, prepared for a scene, loaded again."""

from __future__ import annotations

import hashlib
import importlib
from pathlib import Path
from typing import Any

from extrags.config import CoarseConfig, EnhanceConfig
from extrags.config.backends import BACKEND_NAME, BACKENDS, BackendEntry
from extrags.errors import ConfigError, WeightsError
from extrags.model_files import files_fingerprint
from extrags.restoration.description import DESCRIPTION, read_description
from extrags.restoration.pretrained.captions import check_source, endpoint_digest
from extrags.restoration.protocol import Backend, Enhancer
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.threads import one_torch_thread

__all__ = [
    "backend_of",
    "check_restorer",
    "load_enhancer",
    "register_backend",
    "restorer_digest",
    "train_enhancer",
]


def backend_of(name: str) -> Backend:
    """The backend of a name; its code is imported now.

    Raises:
        ConfigError: for an unknown name; gives the nearest known one.
    """
    found: Any = BACKENDS[BACKEND_NAME.check(name)].implementation
    if isinstance(found, str):
        module, _, attribute = found.partition(":")
        found = getattr(importlib.import_module(module), attribute)
    backend: Backend = found
    return backend


def register_backend(backend: Backend | Any, summary: str, *, version: int = 1) -> None:
    """Make a backend of another program known; `enhance.backend` takes its name from now on.

    The registration holds for this process. Where stages run in other processes, each of them has to
    register the backend.

    Args:
        backend: of the protocol `Backend`; its `name` must be free.
        summary: what it is, in a few words, for help texts.
        version: raise it whenever its results change: it is part of the key under which they are cached.

    Raises:
        ConfigError: for a version below 1, when a part of the protocol is missing, or the name is taken.
    """
    if not isinstance(backend, Backend):
        parts = ("name", "check", "digest", "needs_text", "prepare", "load")
        missing = [part for part in parts if not hasattr(backend, part)]
        raise ConfigError(f"{type(backend).__name__} is no restorer backend: it lacks {', '.join(missing)}")
    if version < 1:
        raise ConfigError(f"version {version} of the restorer backend {backend.name}: expected 1 or more")
    if backend.name in BACKENDS:
        raise ConfigError(f"there is a restorer backend {backend.name} already; choose another name")
    BACKENDS[backend.name] = BackendEntry(summary, backend, version)


def check_restorer(config: EnhanceConfig) -> None:
    """Look for everything that the backend needs besides the scene.

    A model that may be downloaded (`enhance.pretrained.local_files_only=false`) is downloaded here.

    Args:
        config: backend, model and caption.

    Raises:
        WeightsError: when weights are missing or do not fit; says how to get them.
        MissingDependencyError: when a package is missing; says how to install it.
        ConfigError: when settings do not fit each other, the model or the machine.
        SourceNotFoundError: when the file of captions is missing.
        ExtragsError: when the clone of a checkpoint's code does not start.
    """
    backend = backend_of(config.backend)
    if backend.needs_text(config):
        check_source(config.caption)
    backend.check(config)


def restorer_digest(config: EnhanceConfig) -> str | None:
    """Digest of the pretrained model that a scene's restorer starts from, and of the source of its captions.

    A file of captions counts by its content, an endpoint by its address without credentials. Where model and
    file are stored does not change the digest.

    Args:
        config: backend, model and caption.

    Returns:
        None for a backend that starts from nothing.

    Raises:
        ExtragsError: as `check_restorer`.
    """
    backend = backend_of(config.backend)
    model = backend.digest(config)
    parts = [str(model)]
    if backend.needs_text(config):
        texts, endpoint = check_source(config.caption), endpoint_digest(config.caption)
        if texts is not None:
            parts.append(files_fingerprint({"texts": texts}))
        if endpoint is not None:
            parts.append(f"endpoint {endpoint}")
    version = BACKENDS[config.backend].version
    if version > 0:
        parts.append(f"{backend.name} version {version}")
    if len(parts) == 1:
        return model
    return hashlib.blake2b(" ".join(parts).encode(), digest_size=16).hexdigest()


@one_torch_thread()
def train_enhancer(
    scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig
) -> Enhancer:
    """The restorer of a scene: trained on the scene's own pairs, or prepared from a pretrained model.

    Args:
        scene: the coarse scene, trained on `sequence.train`; leave-out reconstructions run where it is.
        sequence: posed frames; only training frames are used.
        config: backend and budgets.
        coarse: settings of the leave-out reconstructions.

    Raises:
        CaptureError: with too few training frames for the embedded backend.
        DivergedError: when a reconstruction or the training does not stay finite.
        WeightsError: when a pretrained model is missing; says how to get it.
        MissingDependencyError: when a pretrained backend lacks a package.
        ConfigError: when its settings do not fit.
    """
    # Virtual views are pinholes, and so are all views that a restorer learns from.
    return backend_of(config.backend).prepare(scene, sequence.as_pinhole(), config, coarse)


def load_enhancer(path: Path) -> Enhancer:
    """Read a restorer that `Enhancer.save` wrote.

    Args:
        path: its folder.

    Raises:
        WeightsError: when a file is missing, damaged, or does not fit this version.
    """
    file = path / DESCRIPTION
    backend = read_description(file).get("backend")
    if backend not in BACKENDS:
        raise WeightsError(f"{file}: unknown backend {backend!r}; known: {', '.join(BACKENDS)}")
    return backend_of(backend).load(path)
