"""`python -m extrags.depth.pretraining FOLDER`: make examples and train the depth completion on them."""

from __future__ import annotations

import argparse
import json
import logging
import math
import time
from dataclasses import asdict
from pathlib import Path

import torch

from extrags.array_files import load_safetensors, save_safetensors
from extrags.depth.completion import CompletionNetwork
from extrags.depth.pretraining.cavities import KINDS
from extrags.depth.pretraining.examples import SIZES, Examples, make_examples
from extrags.depth.pretraining.training import (
    CompletionTraining,
    ExampleBank,
    matched,
    mix_weights,
    score,
    train_completion,
    unmatched,
)
from extrags.output_files import write_file

log = logging.getLogger("extrags.depth.pretraining")

FURTHER_SEED = 1_000_003
"""For each example that was made before, so much is added to the seed of further ones."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where network and record are written")
    parser.add_argument("--batches", type=int, default=120, help="batches of clips to make")
    parser.add_argument("--clips", type=int, default=24, help="clips per batch")
    parser.add_argument("--validation-batches", type=int, default=4)
    parser.add_argument("--iterations", type=int, default=20_000)
    parser.add_argument("--batch", type=int, default=48, help="frames per step")
    parser.add_argument(
        "--training-seconds", type=float, default=math.inf, help="end training after this time"
    )
    parser.add_argument("--learning-rate", type=float, default=1.5e-3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--start",
        type=Path,
        help="weights to train further; they also complete the depths that the second sweep runs around",
    )
    parser.add_argument(
        "--keep", type=float, default=0.0, help="share of the starting weights in the mean that is written"
    )
    parser.add_argument(
        "--bank", type=Path, help="examples made before: read if there, and written with those made now"
    )
    parser.add_argument("--seconds", type=float, default=1e9, help="stop making examples after this time")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--most-examples", type=int, default=10**9, help="stop making examples at so many")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    options.folder.mkdir(parents=True, exist_ok=True)
    device = torch.device(options.device)
    generator = torch.Generator(device=device).manual_seed(options.seed)
    begun = time.monotonic()
    bank, held_out = ExampleBank(generator), ExampleBank(generator)
    if options.bank is not None and options.bank.exists():
        stored = torch.load(options.bank, map_location=device, weights_only=True)
        for target, parts in zip((bank, held_out), stored, strict=True):
            for channels, truth, known in parts:
                target.add(Examples(channels, truth, known))
        log.info("%d examples read", len(bank))
        # From the seed alone the examples that were read would be made once more, and with fewer batches to
        # validate with some of those that validate would be trained on.
        generator.manual_seed(options.seed + FURTHER_SEED * (len(bank) + len(held_out)))
    network = CompletionNetwork().to(device)
    if options.start is not None:
        network.load_state_dict(
            {name: value.float() for name, value in load_safetensors(options.start).items()}
        )
    for number in range(options.batches):
        target = held_out if number < options.validation_batches else bank
        kind, size = KINDS[number % len(KINDS)], SIZES[(number // len(KINDS)) % len(SIZES)]
        with torch.no_grad():
            completes = None if options.start is None else network
            made = make_examples(kind, options.clips, generator, size, network=completes)
        if made is not None:
            target.add(made)
        if number % 10 == 0:
            log.info("batch %d: %d examples, %.0f s", number, len(bank), time.monotonic() - begun)
        if time.monotonic() - begun > options.seconds or len(bank) >= options.most_examples:
            break
    if options.bank is not None and options.batches:
        parts = [
            [(part.channels, part.truth, part.known) for part in kept.all_of_size()]
            for kept in (bank, held_out)
        ]
        torch.save(parts, options.bank)
    log.info("%d examples, %d to validate, %.0f s", len(bank), len(held_out), time.monotonic() - begun)
    if not len(bank) or not len(held_out):
        parser.error("there are no examples to train on, or none to validate with: more batches, or a bank")
    before = _scores(network, held_out)
    log.info("before: %s", before)
    settings = CompletionTraining(
        options.iterations, options.batch, options.learning_rate, seconds=options.training_seconds
    )

    def told(iteration: int, means: dict[str, float]) -> None:
        if iteration % 500 == 0:
            log.info(
                "%d %s %.0f s",
                iteration,
                {k: round(v, 4) for k, v in means.items()},
                time.monotonic() - begun,
            )

    network = train_completion(bank, settings, network, told=told, half=device.type == "cuda")
    if options.start is not None and options.keep > 0:
        mix_weights(network, load_safetensors(options.start), options.keep)
    scores = _scores(network, held_out)
    log.info("after: %s", scores)
    weights = {name: value.cpu().half() for name, value in network.state_dict().items()}
    save_safetensors(options.folder / "completion.safetensors", weights)
    record = {
        "settings": {name: value for name, value in asdict(settings).items() if value != math.inf},
        "examples": len(bank),
        "seed": options.seed,
        "keep": options.keep,
        "scores_before": before,
        "scores": scores,
    }
    write_file(options.folder / "completion.json", json.dumps(record, indent=1) + "\n")


def _scores(network: CompletionNetwork, held_out: ExampleBank) -> dict[str, dict[str, float]]:
    """Of frames that have sources, and of those that nothing was matched with."""
    examples = held_out.all_of_size()
    parts = {"matched": matched(examples), "unmatched": unmatched(examples)}
    return {
        name: asdict(score(network, part)) for name, part in parts.items() if any(len(p.truth) for p in part)
    }


if __name__ == "__main__":
    main()
