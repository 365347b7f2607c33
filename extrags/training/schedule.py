"""Settings of one optimisation: learning rates, weights and budgets."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from extrags.config import DensifyConfig, LightConfig, OptimiserConfig
from extrags.events import Progress
from extrags.training.normal_term import NormalTerm

__all__ = ["DECAY_EXPONENT", "LIGHT_COOLDOWN_FINAL", "Schedule"]

DECAY_EXPONENT = 1.5
"""Of the iteration, in the decay of rates: above 1, so that their sum stays finite."""
LIGHT_COOLDOWN_FINAL = 0.03
"""Share of the light's rates that a cool-down leaves at its end."""


@dataclass(frozen=True)
class Schedule:
    """Everything the optimisation needs besides scene and views."""

    stage: str
    iterations: int
    extent: float
    optimiser: OptimiserConfig
    light: LightConfig
    densify: DensifyConfig
    dssim_weight: float
    depth_weight: float
    depth_weight_final_share: float
    depth_scale: float
    sh_every: int | None
    """Iterations between two raises of the degree of the harmonics; None: all are in use from the start."""
    seed: int
    photometric_weight: float = 1.0
    """Factor of the L1 and SSIM terms of every view; the depth term is beside it."""
    depth_huber_delta: float | None = None
    """Of a Huber loss of depths, in `depth_scale`; None: the depth term compares inverse depths."""
    normals: NormalTerm | None = None
    light_cooldown_share: float = 0.0
    """Of the iterations, the last ones, in which the light's rates fall to `LIGHT_COOLDOWN_FINAL`."""
    glare_decided_at: int | None = None
    """Iteration after which glare stays only where there is enough of it (`LightConfig.glare_kept_from`)."""
    colors_decided_at: int | None = None
    """Iteration after which haze and white balance of single frames stay only where there is enough of them;
    None: they are not learned."""
    iterations_before: int = 0
    """Of earlier rounds of the same stage: its progress counts them."""
    iterations_after: int = 0
    """The same of later rounds."""

    def progress(self, iteration: int, values: dict[str, float]) -> Progress:
        """How far the stage is after an iteration, all of its rounds counted."""
        done = self.iterations_before + iteration + 1
        return Progress(
            self.stage, done, self.iterations_before + self.iterations + self.iterations_after, values
        )

    def learning_rates(self, iteration: int) -> dict[str, float]:
        """Rates at an iteration: positions fall log-linearly, the others as `rate_share` says."""
        rates = self.optimiser
        share = self.rate_share(iteration)
        t = iteration / max(1, self.iterations)
        means = math.exp((1 - t) * math.log(rates.means) + t * math.log(rates.means_final))
        return {
            "means": means * self.extent,
            "quats": share * rates.quats,
            "scales": share * rates.scales,
            "opacities": share * rates.opacities,
            "sh0": share * rates.sh0,
            "shN": share * rates.shN,
        }

    def rate_share(self, iteration: int) -> float:
        """Share of their first value that rates still have; those of positions follow a law of their own.

        Adam's steps keep their length where the gradient is all noise, so that what no view determines drifts
        as long as the rates stay: held-out views then get worse with every iteration. Shares of this form
        have a finite sum: however long a run is, it drifts no farther.
        """
        after = self.optimiser.decay_after
        return 1.0 if after is None else float((after / max(after, iteration)) ** DECAY_EXPONENT)

    def light_rate_share(self, iteration: int) -> float:
        """The same of the light, whose rates also fall log-linearly over the last iterations.

        All pixels hang on a few parameters: where their last steps are long, the brightness of the whole
        scene ends a few per cent from where it belongs.
        """
        begin = (1 - self.light_cooldown_share) * self.iterations
        cooled = max(0.0, iteration - begin) / max(1.0, self.iterations - begin)
        return self.rate_share(iteration) * float(LIGHT_COOLDOWN_FINAL**cooled)

    def resumed(self, *, seed: int) -> Schedule:
        """The schedule for a scene that exists already: all harmonics are active from the first step."""
        return replace(self, sh_every=None, seed=seed)

    def sh_degree_at(self, iteration: int, highest: int) -> int:
        """Degree of the harmonics in use, for a scene with harmonics up to `highest`."""
        return highest if self.sh_every is None else min(iteration // self.sh_every, highest)

    def depth_weight_at(self, iteration: int) -> float:
        """Weight of the depth term, falling log-linearly."""
        return self.depth_weight * float(
            self.depth_weight_final_share ** (iteration / max(1, self.iterations))
        )
