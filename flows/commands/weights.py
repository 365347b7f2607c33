"""`weights lpips`."""

from __future__ import annotations

import argparse
import os
from typing import Any, get_args

from extrags.errors import installed_with
from extrags.user_paths import expanded
from flows.commands.common import set_up_logging, write_json
from flows.commands.options import Parser, add_json, add_verb

__all__ = ["add_arguments", "lpips"]


def add_arguments(parser: Parser) -> None:
    """The verbs below `extrags weights`."""
    from extrags.config import LpipsNet

    parser.description = "Which weights of networks are on this machine, and their download."
    verbs = parser.add_subparsers(metavar="lpips", required=True, parser_class=Parser)
    made = add_verb(
        verbs,
        "lpips",
        lpips,
        "where the weights of LPIPS are",
        description="Say where the weights of each LPIPS backbone are, or what is missing or damaged; exit "
        "code 1 when anything is. Nothing is downloaded unless --download asks for it.",
    )
    made.add_argument(
        "--nets",
        nargs="+",
        choices=get_args(LpipsNet),
        default=["alex", "vgg"],
        help="backbones (default: alex vgg)",
    )
    made.add_argument(
        "--download",
        action="store_true",
        help="download missing backbones (AlexNet 233 MiB, VGG16 528 MiB, SqueezeNet 5 MiB) from "
        "download.pytorch.org into torch's cache; the heads come with " + installed_with("lpips"),
    )
    add_json(made)


def lpips(given: argparse.Namespace) -> int:
    """`extrags weights lpips`; exit code 1 when weights are missing or damaged."""
    set_up_logging(debug=given.debug, terminal=True, quiet=given.quiet)
    from extrags.errors import WeightsError
    from extrags.metrics.lpips_weights import (
        WEIGHTS_VARIABLE,
        absent_parts,
        check_weights,
        download_backbone,
        find_heads,
        find_weights,
    )

    named = os.environ.get(WEIGHTS_VARIABLE, "")
    # Where the variable names a folder, no other place is searched.
    elsewhere = not named or expanded(named).is_file()
    found: list[dict[str, Any]] = []
    for net in given.nets:
        case: dict[str, Any] = {"net": net, "files": [], "missing": ""}
        found.append(case)
        try:
            files = find_weights(None, net)
        except WeightsError as error:
            # Without heads a backbone is of no use.
            if not given.download or not elsewhere or find_heads(net) is None:
                case["missing"] = (absent_parts(net) if elsewhere else "") or str(error)
                continue
            download_backbone(net)
            files = find_weights(None, net)
        try:
            check_weights(files, net)
        except WeightsError as error:
            case["missing"] = f"damaged: {error}"
            continue
        case["files"] = [str(file) for file in files]
    if given.json != "-":
        from flows.terminal import console

        for case in found:
            where = " and ".join(case["files"]) or case["missing"]
            console().print(f"{case['net']}: {where}", soft_wrap=True, markup=False, highlight=False)
    write_json(found, given.json)
    return 1 if any(case["missing"] for case in found) else 0
