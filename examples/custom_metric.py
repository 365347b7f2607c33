"""A metric of one's own, registered from outside: it appears wherever metrics are computed or shown.

python examples/custom_metric.py phantom/0@sparse
"""

from __future__ import annotations

import sys

from torch import Tensor

import extrags
from extrags.metrics.image import means_in_regions


def chroma_error(render: Tensor, target: Tensor) -> Tensor:
    """Absolute difference of the share of red, per pixel: errors of hue that no brightness explains.

    Args:
        render: in [0, 1], [N, H, W, 3].
        target: the same.

    Returns:
        [N, H, W].
    """
    red = [image[..., 0] / image.sum(-1).clamp_min(1e-3) for image in (render, target)]
    return (red[0] - red[1]).abs()


CHROMA_ERROR = extrags.Metric(
    "chroma_error", "Chroma error", higher_is_better=False, measure=means_in_regions(chroma_error)
)


def evaluated(source: str, config: extrags.PipelineConfig) -> extrags.EvaluationResult:
    """Reconstruct a source and evaluate it, the registered metrics included."""
    sequence = extrags.read(source, config.ingest)
    found = extrags.reconstruct(sequence, config.coarse)
    # Poses that did not agree with the images, and haze, are corrected.
    sequence = extrags.as_reconstructed(sequence, found)
    result = extrags.evaluate(found.scene, sequence)
    for name in ("psnr", CHROMA_ERROR.key):
        observed = result.metrics["observed"][name]
        # Without geometry in the source nobody knows which surface was observed.
        known = "" if observed is None else f", observed surface {observed:.4f}"
        print(f"{name}: {result.metrics[name]:.4f}{known}")
    return result


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    extrags.register_metric(CHROMA_ERROR)
    evaluated(sys.argv[1], extrags.PROFILES["quick"])
