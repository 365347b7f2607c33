"""Optimisation of scenes: coarse reconstruction from real views, fine-tuning with virtual ones."""

from __future__ import annotations

from extrags.training.continuing import EarlierScene as EarlierScene
from extrags.training.finetuning import finetune as finetune
from extrags.training.optimise import TrainingResult as TrainingResult
from extrags.training.reconstruction import as_reconstructed as as_reconstructed
from extrags.training.reconstruction import reconstruct as reconstruct
from extrags.training.starting import median_depth as median_depth
from extrags.training.starting import starting_gaussians as starting_gaussians
