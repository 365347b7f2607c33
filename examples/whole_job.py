"""The whole job in memory: reconstruct, explore, restore, fine-tune, evaluate.

python examples/whole_job.py phantom/0@sparse scene.ply
"""

from __future__ import annotations

import sys
from pathlib import Path

import extrags


def whole_job(source: str, ply: Path, config: extrags.PipelineConfig) -> extrags.Result:
    """Take a source through all stages, write the final scene, and print what was decided and reached."""
    ply.parent.mkdir(parents=True, exist_ok=True)  # not after all the work
    result = extrags.run_pipeline(extrags.read(source, config.ingest), config)
    result.scene.gaussians.write_ply(ply)
    for stage, reason in result.skipped.items():
        print(f"{stage} skipped: {reason}")
    for which, evaluation in result.evaluations.items():
        metrics = evaluation.metrics
        print(f"{which}: {metrics['psnr']:.2f} dB PSNR, {metrics['ssim']:.3f} SSIM on held-out views")
    return result


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    whole_job(sys.argv[1], Path(sys.argv[2]), extrags.PROFILES["quick"])
