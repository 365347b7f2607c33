"""What trials of the fine-tuning say: how much of it is kept, and why."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Int

from extrags.config import FinetuneConfig
from extrags.restoration.restored_renders import RestoredShares
from extrags.store.storable import Storable

__all__ = ["Judgement", "Trial", "decide"]


@dataclass(frozen=True)
class Trial:
    """One way to fine-tune, tried on left-out frames.

    Args:
        amount: factor of `finetune.pseudo_weight`.
        coarse_psnr_db: mean PSNR of the trial's coarse scene on the left-out frames.
        final_psnr_db: the same after its fine-tuning.
        gain_db: mean difference of the two, frame by frame.
        standard_error_db: of that mean.
        over_control_db: mean difference to the control, frame by frame.
        over_control_error_db: standard error of that mean.
        holes_only: whether virtual views only filled the holes of the control.
    """

    amount: float
    coarse_psnr_db: float
    final_psnr_db: float
    gain_db: float
    standard_error_db: float
    over_control_db: float
    over_control_error_db: float
    holes_only: bool = False

    def holds(self, max_loss_db: float) -> bool:
        """Whether left-out frames keep their quality.

        The mean may fall behind the coarse scene's by `max_loss_db`. Behind the control it may fall by its
        standard error more: with few frames a difference that small is no evidence, and a scene that gives
        its virtual views up has nothing where no real view looked.
        """
        behind_control_db = -(self.over_control_db + self.over_control_error_db)
        return self.gain_db >= -max_loss_db and behind_control_db <= max_loss_db

    def added_error(self, control: Trial) -> float:
        """Root of the mean squared error of left-out frames that the control has not, of values in [0, 1]."""
        mean_square, its = (10 ** (-trial.final_psnr_db / 10) for trial in (self, control))
        return math.sqrt(max(0.0, mean_square - its))


@dataclass(frozen=True)
class Judgement(Storable):
    """How much of the fine-tuning is kept, and why.

    Args:
        amount: factor of `finetune.pseudo_weight`; 0 fine-tunes on real views alone; None keeps the coarse
            scene.
        reason: in words, with the number it rests on.
        trials: in the order they were made.
        left_out: positions, among the training frames, of the frames left out.
        restored_shares: how much of views restored in the image serves, from the trial that is kept; None
            where that was not measured.
        holes_only: whether virtual views only fill what real views alone leave open.
    """

    stored_as: ClassVar[str] = "judgement.json"

    amount: float | None
    reason: str
    trials: tuple[Trial, ...] = ()
    left_out: tuple[int, ...] = ()
    restored_shares: RestoredShares | None = None
    holes_only: bool = False

    def applied_to(self, config: FinetuneConfig) -> FinetuneConfig:
        """The settings with the weight of virtual views that is kept, and their share in further rounds.

        Shares become no larger than left-out frames allow. For amounts above zero; others change nothing.
        """
        if not self.amount:
            return config
        changes: dict[str, float] = {"pseudo_weight": self.amount * config.pseudo_weight}
        if self.holes_only:
            # There are no further rounds.
            changes["holes_only"] = True
        elif self.restored_shares is not None and self.restored_shares != RestoredShares():
            changes["known_share"] = min(config.known_share, self.restored_shares.known)
            changes["invented_share"] = min(config.invented_share, self.restored_shares.invented)
        return config.model_copy(update=changes)

    def save(self, path: Path) -> None:
        """Write as JSON."""
        path.write_text(json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, path: Path) -> Judgement:
        """Read what `save` wrote."""
        values = json.loads(path.read_bytes())
        trials = tuple(Trial(**trial) for trial in values["trials"])
        left_out = tuple(values["left_out"])
        shares = values["restored_shares"]
        shares = None if shares is None else RestoredShares(**shares)
        return cls(values["amount"], values["reason"], trials, left_out, shares, values["holes_only"])


def decide(trials: Sequence[Trial], max_loss_db: float, left: Int[np.ndarray, "m"]) -> Judgement:
    """The judgement on trials.

    Args:
        trials: the control first, then falling amounts, of which the last alone may hold, and at the end that
            of holes alone, where the control holds and no amount does.
        max_loss_db: mean PSNR that left-out frames may lose.
        left: positions, among the training frames, of the frames left out.
    """
    control, last = trials[0], trials[-1]
    names = [
        "real views alone",
        *("in holes alone" if trial.holes_only else f"weight x {trial.amount:g}" for trial in trials[1:]),
    ]
    changes = ", ".join(
        f"{trial.gain_db:+.2f} dB ({name})" for name, trial in zip(names, trials, strict=True)
    )
    frames = f"on {len(left)} training frames left out of a trial, fine-tuning changes PSNR by {changes}"
    amount: float | None = None
    if last.amount > 0 and last.holds(max_loss_db):
        amount = last.amount
        outcome = "virtual views are kept"
        if last.holes_only:
            outcome = "real views alone train the scene, and virtual ones only fill its holes"
        elif amount < 1:
            outcome = f"virtual views weigh {amount:g} of finetune.pseudo_weight"
        # They may be kept with less gain than real views alone: the rule has to stand beside the numbers.
        outcome += (
            ": with them these frames, which lie near the path, lose no more than "
            f"{max_loss_db:g} dB against the coarse scene and, but for the standard error of that "
            "difference, against real views alone"
        )
    elif control.holds(max_loss_db):
        amount = 0.0
        outcome = "fine-tuning is on real views alone"
    else:
        why = f"all lose more than {max_loss_db:g} dB"
        if any(trial.gain_db >= -max_loss_db for trial in trials):
            # Virtual views were compared with real ones whose light did not come to rest.
            why = (
                f"real views alone lose more than {max_loss_db:g} dB where their light comes to rest, and "
                "virtual ones fall behind them where it does not"
            )
        outcome = f"{why}: the coarse scene is kept"
    only = last.holes_only and bool(amount)
    return Judgement(amount, f"{frames}; {outcome}", tuple(trials), tuple(left.tolist()), holes_only=only)
