"""What Prefect refuses when a run is submitted: misspelt settings, values out of range, relative stores."""

from __future__ import annotations

import asyncio
from functools import cache
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from jsonschema.exceptions import best_match
from prefect import get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterDeploymentId
from prefect.exceptions import PrefectHTTPStatusError
from prefect.utilities.schema_tools.validation import is_valid_schema, preprocess_schema, validate

from extrags.config import PipelineConfig, profile_config
from extrags.config.settings import settings_of
from extrags.data_directories import user_directories
from extrags.errors import ConfigError
from flows.benchmark import benchmark
from flows.dataset import reconstruct_dataset
from flows.parameters import settings_schema
from flows.sequence import reconstruct_sequence
from flows.settings import PLACES, run_store
from tests.flows.tiny import SEQUENCE, TINY

FLOWS = {
    "sequence": (reconstruct_sequence, {"sequence": SEQUENCE}),
    "dataset": (reconstruct_dataset, {"sequences": [SEQUENCE]}),
    "benchmark": (benchmark, {"sequences": [SEQUENCE]}),
}
WRONG = [
    ({"coarse.iteration": 5}, r"settings: 'coarse.iteration' is not one of \['coarse.iterations'"),
    ({"coarse.light.exponnt": 5}, r"is not one of \['coarse.light.enabled'"),
    ({"coarse.Iterations": 5}, r"is not one of \['coarse.iterations', 'coarse.sh_degree'"),
    ({"coars.iterations": 5}, r"'coars.iterations' does not match '\^\(ingest\|poses"),
    ({"coarse": {"iterations": 5}}, r"'coarse' does not match"),
    ({"coarse.iterations": 0}, r"settings\['coarse.iterations'\].*0 is less than the minimum of 1"),
    ({"coarse.iterations": 1.5}, r"settings\['coarse.iterations'\].*is not of type 'integer'"),
    ({"coarse.iterations": None}, r"settings\['coarse.iterations'\].*None is not of type 'integer'"),
    ({"coarse.thickness": 0}, r"settings\['coarse.thickness'\]"),
    ({"coarse.light.enabled": "no"}, r"settings\['coarse.light.enabled'\].*is not of type 'boolean'"),
    ({"enhance.backend": "clasical"}, r"'clasical' is not one of \['embedded', 'classical'"),
    ({"enhance.channels": [8, 8]}, r"\[8, 8\] is too short"),
]


class RefusedError(Exception):
    """What the server says."""


@cache
def schema_of(name: str) -> dict[str, Any]:
    return preprocess_schema(FLOWS[name][0].parameters.model_dump())


def submitted(name: str, **parameters: Any) -> None:
    """Check parameters as the server does, but for its check of the schema itself, which takes longest."""
    errors = validate({**FLOWS[name][1], **parameters}, schema_of(name), preprocess=False)
    found = best_match(errors)
    if found is not None:
        raise RefusedError(f"{found.json_path}: {found.message}")


@pytest.mark.parametrize("name", FLOWS)
def test_the_schemas_are_valid(name: str) -> None:
    is_valid_schema(FLOWS[name][0].parameters.model_dump())


class TestSchema:
    @pytest.mark.parametrize("name", FLOWS)
    def test_good_settings_are_accepted(self, name: str) -> None:
        for settings in ({}, None, TINY, {"coarse.optimiser.decay_after": None}):
            submitted(name, settings=settings)

    @pytest.mark.parametrize("name", FLOWS)
    @pytest.mark.parametrize(("settings", "message"), WRONG)
    def test_wrong_ones_are_refused_with_what_is_near(
        self, name: str, settings: dict[str, Any], message: str
    ) -> None:
        with pytest.raises(RefusedError, match=message):
            submitted(name, settings=settings)

    @pytest.mark.parametrize("profile", ["quick", "balanced", "paper"])
    def test_every_setting_is_listed_and_takes_what_the_profiles_give_it(self, profile: str) -> None:
        tree = profile_config(profile).model_dump(mode="json")
        settings = {}
        for name in settings_of(PipelineConfig):
            value: Any = tree
            for part in name.split("."):
                value = value[part]
            settings[name] = value
        submitted("sequence", settings=settings)
        assert set(settings_schema()["properties"]) == set(settings)

    def test_sequences_are_texts(self) -> None:
        for wrong in ([""], [3], [], "phantom/0@sparse"):
            with pytest.raises(RefusedError):
                submitted("dataset", sequences=wrong)
        with pytest.raises(RefusedError):
            submitted("sequence", sequence="")

    def test_stores_are_absolute(self) -> None:
        for good in (None, "/data/store", "~/store", "s3://bucket/prefix"):
            submitted("dataset", store=good)
        for wrong in ("", ".extrags", "store"):
            with pytest.raises(RefusedError, match=r"\$\.store: "):
                submitted("dataset", store=wrong)

    def test_matrix_and_variants(self) -> None:
        submitted("dataset", matrix={"coarse.iterations": [500, 1000]}, seeds=[0, 1], methods=["3dgs"])
        submitted("benchmark", variants={"dim": {"method": "coarse", "coarse.light.enabled": False}})
        for name, wrong in (
            ("dataset", {"matrix": {"coarse.iteration": [5]}}),
            ("dataset", {"matrix": {"coarse.iterations": 5}}),
            ("dataset", {"matrix": {"coarse.iterations": [0]}}),
            ("dataset", {"seeds": []}),
            ("dataset", {"methods": ["nerf"]}),
            ("dataset", {"only": "broken"}),
            ("benchmark", {"variants": {"dim": {"coarse.lite": 1}}}),
            ("benchmark", {"seeds": [0, -1]}),
            ("benchmark", {"tolerance": {"psnr": 1}}),
            ("benchmark", {"tolerance": {"psnr_db": -1}}),
            ("benchmark", {"variants": {"a": {"method": "nix"}}}),
            ("benchmark", {"max_failed_share": 1.5}),
        ):
            with pytest.raises(RefusedError):
                submitted(name, **wrong)

    @pytest.mark.parametrize(
        ("name", "wrong"),
        [
            ("dataset", {"seeds": [1, 1]}),
            ("dataset", {"methods": ["3dgs", "3dgs"]}),
            ("dataset", {"matrix": {"coarse.iterations": [5, 5]}}),
            ("benchmark", {"seeds": [1, 1]}),
            ("benchmark", {"methods": ["3dgs", "3dgs"]}),
            ("benchmark", {"profiles": ["quick", "quick"]}),
        ],
    )
    def test_what_is_given_twice(self, name: str, wrong: dict[str, Any]) -> None:
        with pytest.raises(RefusedError, match="has non-unique elements"):
            submitted(name, **wrong)

    @pytest.mark.parametrize("name", ["extrags", "uc-nerf"])
    def test_variants_that_are_named_like_a_method(self, name: str) -> None:
        submitted("benchmark", variants={f"{name}-dim": {"coarse.light.enabled": False}})
        with pytest.raises(RefusedError, match=f"'{name}' should not be valid under .*'coarse'"):
            submitted("benchmark", variants={name: {"coarse.light.enabled": False}})

    def test_none_is_no_list(self) -> None:
        submitted("dataset", seeds=None, methods=None, matrix=None)

    def test_runners(self) -> None:
        for good in ("threads", "dask", "dask:tcp://127.0.0.1:8786"):
            submitted("dataset", runner=good)
        for wrong in ("thread", "threads:2", "dask:", "process", "", None):
            with pytest.raises(RefusedError, match=r"\$\.runner: "):
                submitted("dataset", runner=wrong)


@pytest.mark.usefixtures("prefect_server")
def test_the_server_makes_no_run_of_wrong_settings() -> None:
    deployment = reconstruct_sequence.to_deployment(f"typed-{uuid4().hex}").apply()

    async def ask() -> tuple[str, int]:
        async with get_client() as client:
            with pytest.raises(PrefectHTTPStatusError) as refused:
                await client.create_flow_run_from_deployment(
                    deployment, parameters={"sequence": SEQUENCE, "settings": {"coarse.iteration": 5}}
                )
            await client.create_flow_run_from_deployment(
                deployment, parameters={"sequence": SEQUENCE, "settings": {"coarse.iterations": 5}}
            )
            runs = await client.read_flow_runs(
                flow_run_filter=FlowRunFilter(deployment_id=FlowRunFilterDeploymentId(any_=[deployment]))
            )
            return refused.value.response.text, len(runs)

    said, runs = asyncio.run(ask())
    assert "'coarse.iteration' is not one of ['coarse.iterations'" in said
    assert runs == 1


class TestStore:
    @pytest.fixture(autouse=True)
    def nothing_set(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for variable in PLACES:
            monkeypatch.delenv(variable, raising=False)

    def test_named_else_environment_else_the_users(self, monkeypatch: pytest.MonkeyPatch) -> None:
        assert run_store(None) == str(user_directories()[0] / "store")
        assert Path(run_store(None)).is_absolute()
        monkeypatch.setenv("EXTRAGS_STORE", "/data/store")
        assert run_store(None) == "/data/store"
        assert run_store("s3://bucket/x") == "s3://bucket/x"
        assert run_store("here") == str(Path.cwd() / "here")

    def test_in_a_deployment_it_is_never_relative(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("flows.settings._is_deployed", lambda: True)
        assert run_store("/data/store") == "/data/store"
        with pytest.raises(ConfigError, match=r"the parameter store is here, which is relative"):
            run_store("here")
        monkeypatch.setenv("EXTRAGS_STORE", ".extrags")
        with pytest.raises(ConfigError, match=r"EXTRAGS_STORE is .extrags, which is relative"):
            run_store(None)
        monkeypatch.setenv("EXTRAGS_STORE", "~/store")
        monkeypatch.setenv("EXTRAGS_DATA", "data")
        with pytest.raises(ConfigError, match="EXTRAGS_DATA is data"):
            run_store(None)
