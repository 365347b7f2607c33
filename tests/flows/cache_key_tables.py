"""Which stage follows which, and which settings each reads; `test_cache_keys` holds cache keys against it."""

from __future__ import annotations

from typing import Any

FOLLOWS = {
    "ingest": [
        "poses",
        "training-frames",
        "evaluate-render",
        "uc-nerf-render",
        "evaluate-views",
        "evaluate",
        "report",
    ],
    "poses": ["training-frames", "evaluate-render", "uc-nerf-render", "evaluate-views", "evaluate", "report"],
    "training-frames": ["depth", "depth-frames", "coarse", "uc-nerf", "after-coarse"],
    "depth": ["depth-frames", "report"],
    "depth-frames": ["coarse", "uc-nerf", "after-coarse"],
    "coarse": ["after-coarse", "evaluate-render", "report"],
    "uc-nerf": ["uc-nerf-render", "report"],
    "after-coarse": [
        "assess",
        "surface",
        "freespace",
        "explore-start",
        "explore-branch",
        "explore",
        "enhance-train",
        "enhance-keyframes",
        "enhance-restore",
        "finetune-judge",
        "finetune",
        "evaluate-restore",
    ],
    "assess": ["plan"],
    # What was measured is in the plan, and so on the page.
    "plan": ["report"],
    "surface": ["freespace", "report"],
    "freespace": ["explore-start", "explore-branch", "explore", "report"],
    "explore-start": ["explore-branch", "explore-merge"],
    "explore-branch": ["explore-merge"],
    "explore-merge": ["explore"],
    "explore": ["enhance-keyframes", "enhance-restore", "finetune-judge", "report"],
    "enhance-train": ["enhance-keyframes", "enhance-restore", "finetune-judge", "evaluate-restore"],
    "enhance-keyframes": ["enhance-restore"],
    "enhance-restore": ["enhance"],
    "enhance": ["finetune", "report"],
    # Of the judgement only the amount that is kept counts later.
    "finetune-judge": [],
    "finetune": ["evaluate-render", "report"],
    "evaluate-render": ["evaluate-restore", "evaluate-views", "evaluate", "report"],
    "evaluate-restore": ["evaluate-views", "evaluate", "report"],
    "uc-nerf-render": ["evaluate-views", "evaluate", "report"],
    "evaluate-views": [],
    "evaluate": ["report"],
    "report": [],
}
"""Stages by what reads their artefacts; `after-coarse` reads the scene and the training frames."""

EXPLORE = ("explore-start", "explore-branch", "explore")
RESTORE = ("enhance-keyframes", "enhance-restore")
ALL_AFTER_COARSE = ("depth", "uc-nerf", "coarse", "uc-nerf-render", "assess")

ON_DEVICE = (
    "coarse",
    "assess",
    "enhance-train",
    "finetune-judge",
    "finetune",
    "evaluate-render",
    "evaluate-views",
    "evaluate",
)
"""Stages that optimise, render or measure where `device` says."""

DIRECTLY: dict[str, tuple[str, ...]] = {
    "device": ON_DEVICE,
    "ingest.calibration": (),  # By content, below.
    "ingest.*": ("ingest",),
    "poses.replace_given": (),  # Decides whether the stage runs; below.
    "poses.*": ("poses",),
    "depth.completion": (),  # By content, below.
    "depth.monocular": (),  # By content, below.
    "depth.*": ("depth",),
    "coarse.train_on": (),  # Allowed for the oracle alone; below.
    "coarse.*": ("coarse",),
    "continuation.*": (),  # Nothing is gone on from here; `test_continuation`.
    "imported.*": (),  # Without a scene nothing is imported; below.
    "uc_nerf.enabled": ALL_AFTER_COARSE,
    "uc_nerf.*": (),  # Reads nothing here; below.
    "assess.min_hole_share": ("plan",),
    "assess.full_budget_share": ("plan", *EXPLORE, *RESTORE),
    "assess.force": ("plan", *EXPLORE, *RESTORE),
    "assess.*": ("assess",),
    "surface.*": ("surface",),
    "freespace.*": ("freespace",),
    "explore.trajectories": ("plan", *EXPLORE, *RESTORE),
    "explore.length": ("plan", *EXPLORE, *RESTORE),
    # What a decision saves depends on them.
    "explore.score": ("plan", *EXPLORE),
    "explore.starts": ("plan", *EXPLORE),
    "explore.wave": ("plan", *EXPLORE),
    "explore.directions": ("assess", *EXPLORE),
    "explore.visible_weight": ("assess", *EXPLORE),
    "explore.visibility": ("assess", *EXPLORE),
    "explore.render_width": ("assess", *EXPLORE),
    "explore.*": EXPLORE,
    # The plan says what will restore.
    "enhance.backend": ("plan", "enhance-train"),
    "enhance.judge": ("plan", "enhance-train"),
    "enhance.steps": ("plan", "enhance-train"),
    "enhance.train_iterations": ("plan", "enhance-train"),
    "enhance.pretrained_weights": (),  # By content, below.
    "enhance.keyframes": ("enhance-keyframes", "finetune-judge"),
    "enhance.max_views": ("plan", *RESTORE),
    "enhance.folds": ("plan", "enhance-train"),
    "enhance.fold_iterations": ("plan", "enhance-train"),
    "enhance.judge_pairs": ("plan", "enhance-train"),
    "enhance.samples": ("plan", "enhance-train"),
    "enhance.max_width": ("plan", "enhance-train", *RESTORE, "finetune-judge"),
    "enhance.clips_per_batch": ("enhance-restore",),
    "enhance.references": ("enhance-train", *RESTORE, "finetune-judge"),
    "enhance.reference": ("enhance-train", *RESTORE, "finetune-judge"),
    "enhance.iou": ("enhance-restore", "finetune-judge"),
    "enhance.pixel_confidence": ("enhance-restore", "finetune-judge"),
    "enhance.seed": ("enhance-train", "evaluate-restore"),
    "enhance.caption.*": (),  # The embedded backend reads none of these; below.
    "enhance.pretrained.*": (),
    "enhance.checkpoint.*": (),
    "enhance.*": ("enhance-train",),
    "finetune.judge.enabled": ("plan", "finetune-judge"),
    "finetune.judge.iterations_share": ("plan", "finetune-judge"),
    "finetune.judge.views": ("plan", "finetune-judge"),
    "finetune.judge.*": ("finetune-judge",),
    "finetune.growth": ("plan", "finetune-judge", "finetune"),
    "finetune.holes_only": ("plan", "finetune-judge", "finetune"),
    "finetune.keep_scene": ("plan", "finetune-judge", "finetune"),
    "finetune.rounds": ("plan", "finetune-judge", "finetune"),
    "finetune.iterations": ("plan", "finetune-judge", "finetune"),
    "finetune.*": ("finetune-judge", "finetune"),
    "evaluate.restored": ("evaluate-restore",),
    "evaluate.lpips_nets": ("evaluate-views", "evaluate"),
    "evaluate.lpips_weights": (),  # By content, below.
    "report.*": (),
}
"""Stages that read a setting, by its name; the first pattern that fits holds. All are on the page."""

OTHERS: dict[str, Any] = {
    "enhance.crop": 104,
    "ingest.downscale": 4,
    "ingest.depth_error": 0.1,
    "ingest.calibration": None,
    "depth.completion": None,
    "depth.monocular": None,
    "coarse.train_on": None,
    "continuation.scene": None,
    "imported.scene": None,
    "enhance.pretrained_weights": None,
    "evaluate.lpips_weights": None,
    "device": "cuda",
    "depth.device": "cuda",
    "enhance.precision": "bfloat16",
    "enhance.pretrained.device": "cuda",
    "enhance.checkpoint.device": "cuda",
    "enhance.backend": "classical",
    "enhance.max_views": 50,
    "enhance.channels": (16, 64, 96),
    "evaluate.lpips_nets": ("alex", "vgg"),
}
"""Other values where no rule gives one; None: not compared here, but in a test of its own."""
