"""Captions of scenes, for the pretrained pipelines that read text.

Constant by default. A text per scene comes from a file, or from any server that speaks OpenAI's chat
completions: its address and key are read from EXTRAGS_CAPTION_URL (up to and including `/v1`) and
EXTRAGS_CAPTION_KEY. It receives training frames only. Answers are cached on disk under the digest of the
request, so that the same frames are paid for once.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import logging
import os
import time
import urllib.error
import urllib.request
from dataclasses import asdict, dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from jaxtyping import UInt8

from extrags.config import CaptionConfig
from extrags.data_directories import cache_directory
from extrags.errors import ConfigError, ExtragsError, SourceError, SourceNotFoundError
from extrags.events import MetricRecorded, emit
from extrags.output_files import write_file
from extrags.redaction import without_credentials
from extrags.sequence import EndoscopicSequence
from extrags.user_paths import expanded
from extrags.yaml_text import read_yaml

__all__ = [
    "CACHE_VARIABLE",
    "KEY_VARIABLE",
    "URL_VARIABLE",
    "Caption",
    "caption_of",
    "check_source",
    "endpoint_digest",
]

URL_VARIABLE = "EXTRAGS_CAPTION_URL"
KEY_VARIABLE = "EXTRAGS_CAPTION_KEY"
CACHE_VARIABLE = "EXTRAGS_CACHE"
"""Folder for answers; else the user's cache."""

INSTRUCTION = (
    "These are frames of one endoscopic recording. Describe what the camera sees as the caption of an image "
    "model: organ, surface, colour, texture, light, anything lying on it. One line, under {tokens} tokens, "
    "no patient, no diagnosis, no introduction."
)
RETRIED_STATUS = frozenset({408, 409, 429, 500, 502, 503, 504, 529})
"""HTTP status codes after which a request is tried again."""
MAX_WAIT_S = 60.0

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Caption:
    """Text prompt of a pipeline, and its source.

    Args:
        text: one line.
        source: constant, file or endpoint.
        model: of the endpoint; empty otherwise.
        prompt_tokens: sent, when it was asked.
        completion_tokens: received.
        cost: in the currency of the configured prices.
        cached: whether the answer was in the cache and cost nothing.
    """

    text: str
    source: str
    model: str = ""
    prompt_tokens: int = 0
    completion_tokens: int = 0
    cost: float = 0.0
    cached: bool = False

    def as_dict(self) -> dict[str, Any]:
        """For JSON; without `cached`, which differs between runs."""
        values = asdict(self)
        del values["cached"]
        return values


def caption_of(sequence: EndoscopicSequence, config: CaptionConfig) -> Caption:
    """The caption of a scene.

    Args:
        sequence: only its name and its training frames are used.
        config: where the text comes from.

    Raises:
        ConfigError: when the settings, or the environment, lack what the source needs.
        SourceNotFoundError: when the file of texts is not there.
        SourceError: when it has no text for this scene, or the endpoint's answer has none.
        ExtragsError: when the endpoint refuses, or does not answer after all tries.
    """
    file = check_source(config)
    if file is not None:
        return Caption(_from_file(sequence.name, file), "file")
    if config.source == "endpoint":
        return _from_endpoint(sequence, config)
    return Caption(config.text, "constant")


def check_source(config: CaptionConfig) -> Path | None:
    """Check settings and environment of the source of captions; no request is sent.

    Returns:
        The file of texts, where they come from one.

    Raises:
        ConfigError: when something is not set.
        SourceNotFoundError: when the file of texts is not there.
    """
    if config.source == "endpoint":
        url = os.environ.get(URL_VARIABLE, "")
        if urlsplit(url).scheme not in ("http", "https"):
            raise ConfigError(
                f"enhance.caption.source=endpoint needs the server's address in {URL_VARIABLE}, e.g. "
                f"https://host/v1 (found {url!r}), and its key, if it wants one, in {KEY_VARIABLE}"
            )
        if not config.model:
            raise ConfigError("enhance.caption.source=endpoint needs enhance.caption.model")
    if config.source != "file":
        return None
    if config.file is None:
        raise ConfigError("enhance.caption.source=file needs enhance.caption.file")
    file = expanded(config.file)
    if not file.is_file():
        raise SourceNotFoundError("no such file; expected {name of the sequence: text}", file=file)
    return file


def endpoint_digest(config: CaptionConfig) -> str | None:
    """Digest of the address of the endpoint that captions come from, for cache keys; None for other sources.

    Two servers may answer differently under one name of a model. Credentials in the address do not count: a
    renewed key leads to the same answers.

    Raises:
        ConfigError: as `check_source`.
    """
    if config.source != "endpoint":
        return None
    check_source(config)
    url = without_credentials(os.environ[URL_VARIABLE].rstrip("/"))
    return hashlib.blake2b(url.encode(), digest_size=16).hexdigest()


def _from_file(name: str, file: Path) -> str:
    try:
        texts = read_yaml(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise SourceError(f"not readable as YAML or JSON ({error})", file=file) from error
    if not isinstance(texts, dict):
        raise SourceError(f"expected {{name: text}}, found a {type(texts).__name__}", file=file)
    # The setting after the @ does not change what is seen.
    text = texts.get(name, texts.get(name.split("@")[0]))
    if not isinstance(text, str) or not text.strip():
        raise SourceError(f"no text for {name}; it has {', '.join(map(str, texts)) or 'none'}", file=file)
    return _one_line(text)


def _from_endpoint(sequence: EndoscopicSequence, config: CaptionConfig) -> Caption:
    url, key = os.environ.get(URL_VARIABLE, ""), os.environ.get(KEY_VARIABLE, "")
    images = [_png(sequence.rgb[frame], config.frame_width) for frame in _chosen(sequence, config.frames)]
    question = _question(images, config)
    file = _cache_folder() / f"{_digest(url, question)}.json"
    if file.is_file():
        kept = json.loads(file.read_text(encoding="utf-8"))
        logger.info("caption of %s: kept from before, nothing spent", sequence.name)
        return Caption(**kept, cached=True)
    address = f"{url.rstrip('/')}/chat/completions"
    caption = _understood(_ask(address, key, question, config), address, config)
    _keep(file, caption)
    logger.info(
        "caption of %s by %s: %d tokens sent, %d received, cost %.4f: %s",
        sequence.name,
        config.model,
        caption.prompt_tokens,
        caption.completion_tokens,
        caption.cost,
        caption.text,
    )
    for name in ("prompt_tokens", "completion_tokens", "cost"):
        emit(MetricRecorded("enhance", f"caption_{name}", float(getattr(caption, name))))
    return caption


def _chosen(sequence: EndoscopicSequence, count: int) -> list[int]:
    train = sequence.train
    places = np.linspace(0, len(train) - 1, min(count, len(train))).round().astype(np.int64)
    return [int(train[place]) for place in np.unique(places)]


def _png(image: UInt8[np.ndarray, "h w 3"], width: int) -> str:
    from PIL import Image

    picture = Image.fromarray(image)
    if picture.width > width:
        size = (width, max(1, round(picture.height * width / picture.width)))
        picture = picture.resize(size, Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG")
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def _question(images: list[str], config: CaptionConfig) -> dict[str, Any]:
    shown = [
        {"type": "image_url", "image_url": {"url": f"data:image/png;base64,{image}"}} for image in images
    ]
    return {
        "model": config.model,
        "max_tokens": config.max_tokens,
        "temperature": 0,
        "messages": [
            {"role": "system", "content": INSTRUCTION.format(tokens=config.max_tokens)},
            {"role": "user", "content": shown},
        ],
    }


def _digest(url: str, question: dict[str, Any]) -> str:
    text = json.dumps([url.rstrip("/"), question], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _cache_folder() -> Path:
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return expanded(given) / "captions"
    return cache_directory() / "captions"


def _keep(file: Path, caption: Caption) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    # Whole, so that another process never reads half an answer.
    write_file(file, json.dumps(caption.as_dict(), indent=2) + "\n")


def _ask(address: str, key: str, question: dict[str, Any], config: CaptionConfig) -> dict[str, Any]:
    """The endpoint's answer; transient faults are retried with growing pauses."""
    headers = {"Content-Type": "application/json"}
    if key:
        headers["Authorization"] = f"Bearer {key}"
    request = urllib.request.Request(address, json.dumps(question).encode(), headers, method="POST")
    wait_s, problem = config.retry_wait_s, ""
    for attempt in range(config.retries + 1):
        if attempt:
            time.sleep(min(wait_s, MAX_WAIT_S))
            wait_s *= 2
        try:
            with urllib.request.urlopen(request, timeout=config.timeout_s) as reply:
                answer = json.loads(reply.read())
        except urllib.error.HTTPError as error:
            with error:
                problem = f"HTTP {error.code} {error.reason}: {error.read(300).decode(errors='replace')}"
                wait_s = max(wait_s, _asked_wait(error.headers.get("Retry-After")))
            if error.code not in RETRIED_STATUS:
                raise ExtragsError(f"caption endpoint {address} refused: {problem}") from error
        except (OSError, HTTPException) as error:
            problem = f"{type(error).__name__}: {error}"
        except ValueError as error:
            problem = f"no JSON in the answer ({error})"
        else:
            if isinstance(answer, dict):
                return answer
            problem = f"the answer is a {type(answer).__name__}, expected an object"
        logger.warning("caption endpoint %s, try %d: %s", address, attempt + 1, problem)
    raise ExtragsError(
        f"caption endpoint {address} gave no answer in {config.retries + 1} tries, the last: {problem}. "
        "enhance.caption.source=constant needs no endpoint"
    )


def _asked_wait(value: str | None) -> float:
    """Seconds of a Retry-After header; dates are ignored."""
    try:
        return max(0.0, float(value or 0))
    except ValueError:
        return 0.0


def _understood(answer: dict[str, Any], address: str, config: CaptionConfig) -> Caption:
    try:
        text = answer["choices"][0]["message"]["content"]
    except (KeyError, IndexError, TypeError) as error:
        raise SourceError(
            f"the answer has no text: {json.dumps(answer)[:300]}",
            file=address,
            field="choices[0].message.content",
        ) from error
    if not isinstance(text, str) or not text.strip():
        raise SourceError(f"empty text: {text!r}", file=address, field="choices[0].message.content")
    usage = answer.get("usage") or {}
    sent, received = int(usage.get("prompt_tokens") or 0), int(usage.get("completion_tokens") or 0)
    cost = (sent * config.prompt_price + received * config.completion_price) / 1e6
    return Caption(_one_line(text), "endpoint", str(config.model), sent, received, cost)


def _one_line(text: str) -> str:
    return " ".join(text.split())
