"""Credentials in text, errors, logs, settings and manifests."""

from __future__ import annotations

import io
import logging
from pathlib import Path

import pytest
from pydantic import ValidationError

from extrags.config import EnhanceConfig, PipelineConfig
from extrags.errors import ConfigError, SourceError, StoreError
from extrags.redaction import CredentialFilter, has_credentials, without_credentials
from extrags.store import Store

SECRET = "hUsH/y0+secret"
CAPTION_KEY = "sk-caption-0123456789"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (f"s3://AKIA123:{SECRET}@bucket/prefix", "s3://***@bucket/prefix"),
        (f"see https://user:{SECRET}@host:8080/x?y=1.", "see https://***@host:8080/x?y=1."),
        ("ftp://user@host/file", "ftp://***@host/file"),
        (f"https://host/a.mp4?token={SECRET}&start=3", "https://host/a.mp4?token=***&start=3"),
        (
            "https://b.s3.aws/x?X-Amz-Signature=abc&X-Amz-Date=1",
            "https://b.s3.aws/x?X-Amz-Signature=***&X-Amz-Date=1",
        ),
        ("Authorization: Bearer abcdefghijklmnop", "Authorization: Bearer ***"),
        ("proxy-authorization=basic dXNlcjpodXNo", "proxy-authorization=basic ***"),
        ("{'Authorization': 'Basic dXNlcjpodXNo'}", "{'Authorization': 'Basic ***'}"),
        ("(b'Authorization', b'Bearer abcdefghijklmnop')", "(b'Authorization', b'Bearer ***')"),
        (r"Invalid header value b'Bearer abcdefghijklmnop\n'", r"Invalid header value b'Bearer ***\n'"),
        ("refused: Bearer hf_AbCdEfGh0123456789", "refused: Bearer ***"),
        (f"asked with {CAPTION_KEY}", "asked with ***"),
    ],
)
def test_credentials_are_taken_out(text: str, shown: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXTRAGS_CAPTION_KEY", CAPTION_KEY)
    assert without_credentials(text) == shown
    assert without_credentials(shown) == shown
    assert has_credentials(text)


@pytest.mark.parametrize(
    "text",
    [
        "phantom/0@sparse",
        "s3://bucket/phantom/0@sparse",
        "http://127.0.0.1:4200/api",
        "http://127.0.0.1:4200/runs/phantom@sparse",
        "http://host:80",
        "file:///store/c3vdv2/c1@sparse",
        "dask:tcp://10.0.0.1:8786",
        "a basic pipeline of the bearer",
        "/data/basic colonoscopies/theirs.ply",
        "Basic Colonoscopies_2024/C3VDv2@sparse",
        "bearer colonoscopies/Frames_2024/000120.png",
        "https://host/x?profile=quick&seed=3",
    ],
)
def test_other_text_stays(text: str) -> None:
    assert without_credentials(text) == text


def test_errors_do_not_tell() -> None:
    url = f"https://user:{SECRET}@host/x"
    for error in (StoreError(f"{url} is gone"), SourceError(f"from {url}", file=url)):
        assert SECRET not in str(error)
        assert SECRET not in repr(error)
        assert SECRET not in str(vars(error))


def test_logs_do_not_tell() -> None:
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.addFilter(CredentialFilter())
    logger = logging.Logger("redaction")
    logger.addHandler(handler)
    url = f"https://user:{SECRET}@host/x"
    logger.info("opened %s in %d s", url, 3)
    try:
        raise OSError(url)
    except OSError:
        logger.exception("it failed")
    assert SECRET not in stream.getvalue()
    assert "opened https://***@host/x in 3 s" in stream.getvalue()
    assert "OSError: https://***@host/x" in stream.getvalue()


def test_settings_with_credentials_are_refused() -> None:
    url = f"https://user:{SECRET}@hub/model"
    said = (
        r"setting enhance\.pretrained\.model is 'https://\*\*\*@hub/model'; it holds a password, key or token"
    )
    with pytest.raises(ConfigError, match=said) as refused:
        PipelineConfig().with_overrides({"enhance.pretrained.model": url})
    with pytest.raises(ValidationError) as invalid:
        EnhanceConfig.model_validate({"pretrained": {"model": url}})
    assert SECRET not in str(refused.value) + str(invalid.value)


def test_folders_of_ordinary_words_keep_their_names(tmp_path: Path) -> None:
    scene = "/data/basic colonoscopies/theirs.ply"
    assert PipelineConfig().with_overrides({"imported.scene": scene}).imported.scene == scene
    store = Store(tmp_path)
    label = "basic colonoscopies/first"
    with store.slot(stage="toy", version=1, key="toy-v1-0", label=label) as slot:
        slot.save_json("value.json", 1)
    assert store.manifest(slot.ref).label == label


@pytest.mark.parametrize("url", [f"s3://AKIA:{SECRET}@bucket/x", f"https://host/store?token={SECRET}"])
def test_a_store_with_credentials_in_its_url_is_refused(url: str) -> None:
    with pytest.raises(ConfigError, match="in the environment, such as AWS_ACCESS_KEY_ID") as refused:
        Store(url)
    assert SECRET not in str(refused.value)


def test_manifests_do_not_tell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXTRAGS_CAPTION_KEY", CAPTION_KEY)
    store = Store(tmp_path)
    config = {"source": [f"https://user:{SECRET}@host/x"], CAPTION_KEY: 1}
    with store.slot(stage="toy", version=1, key="toy-v1-0", label=f"x {CAPTION_KEY}", config=config) as slot:
        slot.save_json("value.json", 1)
    written = "".join(path.read_text() for path in tmp_path.rglob("*") if path.is_file())
    assert SECRET not in written
    assert CAPTION_KEY not in written
    assert store.verify(slot.ref)


@pytest.mark.parametrize("text", ["a." * 200_000 + "://x", "a://" * 50_000])
def test_long_text_takes_no_square_of_its_length(text: str) -> None:
    # It would come to an end after many minutes.
    assert without_credentials(text) == text
