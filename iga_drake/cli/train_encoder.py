"""`iga train encoder`: the local encoder; see `training/encoder.py`."""

import argparse
import dataclasses

from iga_drake.aligners.iga.local_encoder import EncoderConfig
from iga_drake.training.encoder import EncoderSettings, train_encoder
from iga_drake.training.options import add_run_options, run_options, with_options
from iga_drake.training.ranks import process_group


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga train encoder`."""
    add_run_options(parser)
    parser.add_argument("--float32", action="store_true", help="no bfloat16 autocast")
    parser.add_argument(
        "--size", choices=("paper", "light"),
        help="1.7 M parameters as in the paper (default of a new run), or 0.4 M",
    )  # fmt: skip
    parser.add_argument(
        "--query", choices=("position", "projections"),
        help="what the decoder sees of a query: its position, as in the paper (default of a new "
        "run), or invariants",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Runs the training and prints the scores."""
    settings: EncoderSettings = with_options(EncoderSettings.of(arguments.out), arguments)
    encoder, decoder = settings.encoder, settings.decoder
    if arguments.size:
        light = arguments.size == "light"
        encoder = EncoderConfig.light() if light else EncoderConfig()
        decoder = dataclasses.replace(decoder, width=128 if light else 256)
    if arguments.query:
        decoder = dataclasses.replace(decoder, query=arguments.query)
    with process_group(arguments.device) as device:
        card = train_encoder(
            arguments.out,
            encoder=encoder,
            decoder=decoder,
            config=settings.training,
            samples=settings.samples,
            device=device,
            workers=arguments.workers,
            options=run_options(arguments),
        )
    if "validation" in card:
        scores = card["validation"]
        print(
            f"step {card['step']}, {card['samples_seen']} clouds seen, {card['seconds']:.0f} s; "
            f"validation: accuracy {scores['accuracy']:.3f}, IoU {scores['iou']:.3f}, of the "
            f"volume {scores['iou_uniform']:.3f}"
        )
    return 0
