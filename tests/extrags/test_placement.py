"""What of a run works where, and what is refused."""

from __future__ import annotations

import logging
from typing import Any

import pytest

from extrags import placement
from extrags.config import PipelineConfig
from extrags.errors import ConfigError, MissingDependencyError
from extrags.in_memory_pipeline import InMemoryPipeline
from extrags.placement import Placement, check_device, placements, run_device
from extrags.stages import STAGES
from extrags.store import canonical
from tests.extrags.lit_tube import Tube

ON_DEVICE = {
    ("coarse", "optimisation"),
    ("assess", "training views"),
    ("enhance", "leave-out reconstructions"),
    ("finetune", "judge and optimisation"),
    ("evaluate", "held-out views"),
    ("evaluate", "metrics"),
}


def config(**settings: Any) -> PipelineConfig:
    return PipelineConfig().with_overrides(
        {name.replace("__", "."): value for name, value in settings.items()}
    )


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes this a machine with or without a GPU, and with or without gsplat."""

    def made(*, cuda: bool, gsplat: bool) -> None:
        monkeypatch.setattr("torch.cuda.is_available", lambda: cuda)
        monkeypatch.setattr(placement, "find_spec", lambda name: object() if gsplat else None)

    return made


class TestRunDevice:
    @pytest.mark.parametrize(
        ("asked", "cuda", "gsplat", "lens", "settled"),
        [
            ("auto", True, True, "pinhole", "cuda"),
            ("auto", False, True, "pinhole", "cpu"),
            ("auto", True, False, "pinhole", "cpu"),
            ("auto", True, True, "native", "cpu"),
            ("cpu", True, True, "pinhole", "cpu"),
            # What was made on another machine can be read here.
            ("cuda", False, False, "pinhole", "cuda"),
        ],
    )
    def test_it_is_settled(
        self, machine: Any, asked: str, cuda: bool, gsplat: bool, lens: str, settled: str
    ) -> None:
        machine(cuda=cuda, gsplat=gsplat)
        assert run_device(config(device=asked, ingest__lens=lens)) == settled

    def test_why_auto_is_the_processor_is_said_once(
        self, machine: Any, caplog: pytest.LogCaptureFixture
    ) -> None:
        machine(cuda=False, gsplat=True)
        placement._say_once.cache_clear()
        with caplog.at_level(logging.INFO, logger="extrags.placement"):
            for _ in range(3):
                run_device(config())
        assert caplog.messages == [
            "device=auto: the run is on the processor, since torch sees no CUDA device"
        ]


class TestRefusals:
    def test_no_gpu(self, machine: Any) -> None:
        machine(cuda=False, gsplat=True)
        check_device(config(device="auto"))
        with pytest.raises(ConfigError, match="device=cuda, but torch sees no CUDA device; use auto or cpu"):
            check_device(config(device="cuda"))

    def test_no_gsplat(self, machine: Any) -> None:
        machine(cuda=True, gsplat=False)
        with pytest.raises(MissingDependencyError, match=r"device=cuda needs gsplat: pip install"):
            check_device(config(device="cuda"))

    def test_a_lens_of_the_frames(self, machine: Any) -> None:
        machine(cuda=True, gsplat=True)
        check_device(config(device="cuda"))
        with pytest.raises(ConfigError, match=r"device=cuda: .*ingest\.lens=native.*ingest\.lens=pinhole"):
            check_device(config(device="cuda", ingest__lens="native"))

    def test_a_run_in_memory_makes_nothing_before(
        self, machine: Any, tube: Tube, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        machine(cuda=False, gsplat=True)
        monkeypatch.setattr(InMemoryPipeline, "coarse", lambda self: pytest.fail("something was made"))
        with pytest.raises(ConfigError, match="device=cuda"):
            InMemoryPipeline(tube.sequence, config(device="cuda")).run_stages("coarse")

    def test_an_instruction_set(self, tube: Tube, monkeypatch: pytest.MonkeyPatch) -> None:
        def refused() -> None:
            raise ConfigError("EXTRAGS_ISA")

        monkeypatch.setattr("extrags.raster.native_isa", refused)
        monkeypatch.setattr(InMemoryPipeline, "coarse", lambda self: pytest.fail("something was made"))
        with pytest.raises(ConfigError, match="EXTRAGS_ISA"):
            InMemoryPipeline(tube.sequence, config()).run_stages("coarse")


class TestPlacements:
    def test_on_a_gpu(self, machine: Any) -> None:
        machine(cuda=True, gsplat=True)
        found = {(item.stage, item.work): item for item in placements(config())}
        assert [stage for stage in STAGES if stage not in {stage for stage, _ in found}] == []
        on_gpu = {name for name, item in found.items() if item.device == "cuda"}
        assert on_gpu == ON_DEVICE | {("depth", "stereo and networks")}
        for name in ON_DEVICE - {("evaluate", "metrics")}:
            assert found[name].rasteriser == "gsplat"
        # What stays behind says what it needs there.
        for stage, words in (
            ("surface", "median depth"),
            ("freespace", "transmittance"),
            ("explore", "blending weights"),
        ):
            (item,) = (item for (where, _), item in found.items() if where == stage)
            assert (item.device, item.rasteriser) == ("cpu", "native")
            assert words in item.reason

    @pytest.mark.parametrize(
        ("settings", "cuda", "gsplat", "reason"),
        [
            ({}, False, True, "device=auto: torch sees no CUDA device"),
            ({}, True, False, "device=auto: gsplat is not installed"),
            ({"ingest__lens": "native"}, True, True, "ingest.lens=native"),
            ({"device": "cpu"}, True, True, "device=cpu"),
        ],
    )
    def test_on_the_processor(
        self, machine: Any, settings: dict[str, Any], cuda: bool, gsplat: bool, reason: str
    ) -> None:
        machine(cuda=cuda, gsplat=gsplat)
        found = {(item.stage, item.work): item for item in placements(config(**settings))}
        for name in ON_DEVICE:
            assert found[name].device == "cpu"
            assert reason in found[name].reason
        assert found["coarse", "optimisation"].rasteriser == "native"

    def test_a_network_has_a_device_of_its_own(self, machine: Any) -> None:
        machine(cuda=True, gsplat=True)
        given = config(device="cpu", enhance__backend="sd-img2img", enhance__pretrained__device="cuda")
        found = {(item.stage, item.work): item for item in placements(given)}
        assert found["enhance", "restorer sd-img2img"] == Placement(
            "enhance", "restorer sd-img2img", "cuda", "", "enhance.pretrained.device=cuda"
        )
        assert found["depth", "stereo and networks"].device == "cpu"
        assert ("enhance", "leave-out reconstructions") not in found

    def test_a_radiance_field_stays_on_the_processor(self, machine: Any) -> None:
        machine(cuda=True, gsplat=True)
        found = {item.stage: item for item in placements(config(device="cuda", uc_nerf__enabled=True))}
        assert found["coarse"].device == "cpu"
        assert found["evaluate"].device == "cuda"


class TestSettings:
    def test_stages_whose_own_device_is_auto_take_the_runs(self) -> None:
        given = config(device="cpu", enhance__checkpoint__device="cuda").with_run_device()
        assert given.depth.device == given.enhance.pretrained.device == "cpu"
        assert given.enhance.checkpoint.device == "cuda"
        assert config().with_run_device() == config()

    def test_the_settings_of_a_whole_run_do_not_count_it(self) -> None:
        """Stages do: what the plan and the page are made of says it."""
        assert canonical(config(device="cuda")) == canonical(config())
        assert "device" in canonical(config().depth)
