"""Fit the domain of the package's weights for colons: how the frames look that they were trained on.

    python -m tests.benchmarks.fit_restorer_domain [--trained 80] [--unseen 40] [--processes 2] [--write]

Frames are those of its pretraining colons
(`data_catalog.phantom.pretraining`) from 0 on; colons from 1000 on, which nothing was trained on, set the
limit. `--write` puts the domain into the package's `restorer.json`. Other weights are given theirs by
`extrags pretrain`. Scores of sequences that are named behind
`--score` are printed.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from extrags.restoration.diffusion.network import RestorationNetwork

FIRST_UNSEEN = 1000
DIGITS = 4
"""Significant ones of what is stored: scores change by less than a thousandth."""


def main() -> None:
    """Fit, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trained", type=int, default=80, help="scenes of the distribution")
    parser.add_argument("--unseen", type=int, default=40, help="scenes of the limit")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--score", nargs="*", default=[], metavar="SEQUENCE")
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    from extrags.restoration.diffusion.weights import COLONS, starting_weights
    from extrags.restoration.uncertainty.domain import Domain

    numbers = [*range(given.trained), *range(FIRST_UNSEEN, FIRST_UNSEEN + given.unseen)]
    with ProcessPoolExecutor(given.processes, mp_context=get_context("spawn")) as pool:
        features = list(pool.map(features_of_scene, numbers))
    known, unseen = features[: given.trained], features[given.trained :]
    domain = Domain.fitted(np.concatenate(known), unseen)
    scores = [domain.score(scene) for scene in unseen]
    print(f"unseen scenes: median {np.median(scores):.2f}, at most {max(scores):.2f}")
    for name in given.score:
        print(f"{name}: {domain.score(features_of_sequence(name)):.2f}")
    if not given.write:
        return
    file = starting_weights(COLONS).with_suffix(".json")
    description = json.loads(file.read_text())
    rounded = {name: _rounded(value) for name, value in domain.as_dict().items()}
    place = "the domain's numbers"
    text = json.dumps({**description, "domain": place}, indent=2)
    # In one line: there are thousands.
    file.write_text(text.replace(json.dumps(place), json.dumps(rounded)) + "\n")
    print(f"written: {Path(file).name}")


def features_of_scene(number: int) -> Float[np.ndarray, "n c"]:
    """Of the training frames of a pretraining colon."""
    from data_catalog.phantom.pretraining import pretraining_recording
    from extrags.restoration.diffusion.frame_features import sequence_features

    return sequence_features(_network(), pretraining_recording(number, to_restore=False).sequence)


def features_of_sequence(name: str) -> Float[np.ndarray, "n c"]:
    """Of the training frames of a sequence of the catalogue, as `quick` reads and restores it."""
    import data_catalog
    from extrags.config import profile_config
    from extrags.restoration.diffusion.frame_features import sequence_features

    config = profile_config("quick")
    sequence = data_catalog.read(name, config.ingest)
    small = sequence.at_most_width(config.enhance.working_width(sequence.width))
    return sequence_features(_network(), small)


def _network() -> RestorationNetwork:
    from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
    from extrags.restoration.diffusion.weights import COLONS, starting_weights

    return EmbeddedEnhancer.load(starting_weights(COLONS)).network


def _rounded(value: object) -> object:
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.{DIGITS}g}")


if __name__ == "__main__":
    main()
