"""Settings of the fine-tuning, and of the leave-out test that decides how much of it to keep."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from extrags.config.base import Seed, StageConfig

__all__ = ["FinetuneConfig", "JudgeConfig"]


class JudgeConfig(StageConfig):
    """Leave-out test of the fine-tuning: how much of it to keep."""

    enabled: bool = Field(True, description="False: fine-tuning is kept whatever it does to real views")
    leave_out_every: int = Field(
        5, ge=2, description="one in so many training frames is left out of the trial scene, in short runs"
    )
    iterations_share: float = Field(
        0.4, gt=0, le=1, description="share of the iterations of both stages that a trial has"
    )
    views: int = Field(32, ge=1, description="virtual views restored for the trials")
    max_width: int = Field(160, ge=16, description="wider frames are downscaled for the trials")
    max_loss_db: float = Field(
        0.1, ge=0, description="mean PSNR that left-out frames may lose against the coarse scene"
    )


EARLIER_GROWTH_SHARE = 0.8
"""Of `finetune.growth`, before the last of several rounds."""
FILLING_SHARE = 0.5
"""Iterations of filling holes after `finetune.iterations` on real views alone, as a share of these."""


class FinetuneConfig(StageConfig):
    """Fine-tuning on real and restored views."""

    iterations: int = Field(
        2000, ge=1, description="optimisation steps of all rounds together, one view each"
    )
    rounds: int = Field(
        1,
        ge=1,
        description="with virtual views, how often the steps start over: from the second round on these show "
        "what was restored mixed with what the scene has become, and holes that are left are filled",
    )
    known_share: float = Field(
        0.6,
        ge=0,
        le=1,
        description="in further rounds: of the restored view, where the coarse scene knows the surface; less "
        "where left-out frames show that less is better",
    )
    invented_share: float = Field(
        0.6,
        ge=0,
        le=1,
        description="in further rounds: of the restored view, where it is invented; less where left-out "
        "frames show that less is better",
    )
    densify_share: float = Field(0.6, ge=0, le=1, description="densification ends at this share")
    pseudo_share: float = Field(
        0.5, ge=0, lt=1, description="share of virtual views among the steps, at the start"
    )
    pseudo_share_final: float = Field(0.0, ge=0, lt=1, description="the same at the end; linear in between")
    pseudo_weight: float = Field(
        3.0,
        gt=0,
        description="weight of all virtual views: U_img alone is about 0.2 in a tube, which "
        "would let the real views overrule what the virtual ones add",
    )
    pseudo_depth: bool = Field(
        True, description="restored depth supervises where the scene knows nothing of a pixel"
    )
    loss: Literal["weighted_mean", "weighted_sum", "paper"] = Field(
        "weighted_mean",
        description="colour terms of a virtual view. weighted_mean: L1 and D-SSIM weighted by U_pixel, over "
        "its sum, so that only its pattern counts; weighted_sum: the same over the number of pixels, so that "
        "its magnitude counts; paper: over the number of pixels, D-SSIM without weights",
    )
    dssim_weight: float | None = Field(
        None, ge=0, le=1, description="lambda in fine-tuning; None: coarse.dssim_weight"
    )
    photometric_weight: float = Field(
        1.0,
        gt=0,
        description="factor of (1 - lambda) L1 + lambda (1 - SSIM) / 2 of all views; 3 with lambda = 2/3 is "
        "L1 + (1 - SSIM)",
    )
    depth_weight: float | None = Field(
        None, ge=0, description="weight of the inverse-depth term; None: coarse.depth_weight"
    )
    growth: float = Field(
        2.0,
        ge=1,
        description="limit on the number of Gaussians, seeds and densification together, times "
        "coarse.densify.max_gaussians",
    )
    seed_holes: bool = Field(
        True, description="place new Gaussians where the restored view has surface and none is"
    )
    keep_known: bool = Field(
        True, description="u * restored + (1 - u) * rendered instead of the restored image alone"
    )
    keep_scene: bool = Field(
        False,
        description="the scene's own Gaussians and light stay: only new ones in holes are learned. "
        "imported.keep switches it on for imported scenes",
    )
    holes_only: bool = Field(
        False,
        description="virtual views only fill holes: real ones train the scene alone, whose Gaussians and "
        "light then stay. The judge switches it on where virtual views harm what is known else",
    )
    confidence_floor: float = Field(
        0.1, ge=0, le=1, description="smallest pixel-level weight, so that no pixel drifts freely"
    )
    image_confidence: bool = Field(
        True, description="weight virtual views by U_img; without it all have the same, the mean"
    )
    light_cooldown_share: float = Field(
        0.5,
        ge=0,
        lt=1,
        description="on real views alone, the learning rates of the light fall in this last share of the "
        "iterations; with virtual views, whose exposure is fixed, they do not. 0: never",
    )
    judge: JudgeConfig = JudgeConfig()
    seed: Seed = Field(0, description="seed of all random sampling")

    @model_validator(mode="after")
    def _a_step_in_each_round(self) -> Self:
        if self.rounds > self.iterations:
            raise ValueError(f"{self.rounds} rounds of {self.iterations} iterations in all")
        return self

    @property
    def steps_of_rounds(self) -> tuple[int, ...]:
        """The iterations of each round: as even as they can be."""
        ends = [round(self.iterations * (number + 1) / self.rounds) for number in range(self.rounds)]
        return tuple(end - begin for begin, end in zip([0, *ends[:-1]], ends, strict=True))

    @property
    def parts(self) -> tuple[FinetuneConfig, ...]:
        """Settings of what runs one after the other where there are virtual views."""
        if not self.holes_only:
            return (self,)
        filling = {"keep_scene": True, "iterations": max(1, round(FILLING_SHARE * self.iterations))}
        return tuple(
            self.model_copy(update={"holes_only": False, "rounds": 1, **changes}) for changes in ({}, filling)
        )

    @property
    def growth_before_last(self) -> float:
        """`growth` in all rounds but the last, which so has room for the holes that are left."""
        return max(1.0, EARLIER_GROWTH_SHARE * self.growth)

    @property
    def first_round(self) -> FinetuneConfig:
        """Settings of the first of the rounds alone."""
        if self.rounds == 1:
            return self
        first = {"rounds": 1, "iterations": self.steps_of_rounds[0], "growth": self.growth_before_last}
        return self.model_copy(update=first)
