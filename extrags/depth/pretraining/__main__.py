"""`python -m extrags.depth.pretraining FOLDER`: make examples and train the depth completion on them."""

from __future__ import annotations

import argparse
import json
import logging
import time
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

from extrags.depth.completion import CompletionNetwork
from extrags.depth.pretraining.cavities import KINDS
from extrags.depth.pretraining.examples import SIZES, Examples, make_examples
from extrags.depth.pretraining.training import CompletionTraining, ExampleBank, score, train_completion

log = logging.getLogger("extrags.depth.pretraining")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where network and record are written")
    parser.add_argument("--batches", type=int, default=120, help="batches of clips to make")
    parser.add_argument("--clips", type=int, default=24, help="clips per batch")
    parser.add_argument("--validation-batches", type=int, default=4)
    parser.add_argument("--iterations", type=int, default=20_000)
    parser.add_argument("--batch", type=int, default=48, help="frames per step")
    parser.add_argument("--learning-rate", type=float, default=1.5e-3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start", type=Path, help="weights to train further")
    parser.add_argument("--bank", type=Path, help="examples made before: read if there, and written")
    parser.add_argument("--seconds", type=float, default=1e9, help="stop making examples after this time")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
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
    for number in range(options.batches):
        target = held_out if number < options.validation_batches and not len(held_out) > 400 else bank
        kind, size = KINDS[number % len(KINDS)], SIZES[(number // len(KINDS)) % len(SIZES)]
        with torch.no_grad():
            made = make_examples(kind, options.clips, generator, size)
        if made is not None:
            target.add(made)
        if number % 10 == 0:
            log.info("batch %d: %d examples, %.0f s", number, len(bank), time.monotonic() - begun)
        if time.monotonic() - begun > options.seconds:
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
    network = CompletionNetwork()
    if options.start is not None:
        network.load_state_dict({name: value.float() for name, value in load_file(options.start).items()})
    settings = CompletionTraining(options.iterations, options.batch, options.learning_rate)

    def told(iteration: int, means: dict[str, float]) -> None:
        if iteration % 500 == 0:
            log.info(
                "%d %s %.0f s",
                iteration,
                {k: round(v, 4) for k, v in means.items()},
                time.monotonic() - begun,
            )

    network = train_completion(bank, settings, network, told=told, half=device.type == "cuda")
    scores = score(network, held_out.all_of_size())
    log.info("%s", scores)
    weights = {name: value.cpu().half().contiguous() for name, value in network.state_dict().items()}
    save_file(weights, options.folder / "completion.safetensors")
    record = {
        "settings": asdict(settings),
        "examples": len(bank),
        "seed": options.seed,
        "scores": asdict(scores),
    }
    (options.folder / "completion.json").write_text(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
