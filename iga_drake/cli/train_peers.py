"""`iga train reldist` and the other peers: one command each; see `training/peers.py`."""

import argparse

import torch

from iga_drake.training import reldist, rndf, taxpose
from iga_drake.training.options import add_run_options, run_options, with_options
from iga_drake.training.peers import PeerSettings, train_peer
from iga_drake.training.ranks import process_group

PEERS = {peer.name: peer for peer in (reldist.PEER, taxpose.PEER, rndf.PEER)}


def add_arguments(networks: argparse._SubParsersAction) -> None:
    """Adds a command for each peer."""
    for name, peer in PEERS.items():
        add_run_options(networks.add_parser(name, help=peer.help))


def run(arguments: argparse.Namespace) -> int:
    """Runs the training; a run that was stopped (or killed) goes on from its last checkpoint."""
    torch.set_num_threads(arguments.threads)
    peer = PEERS[arguments.network]
    settings = with_options(PeerSettings.of(arguments.out, peer), arguments)
    with process_group(arguments.device) as device:
        card = train_peer(
            arguments.out,
            peer,
            settings=settings,
            device=device,
            workers=arguments.workers,
            options=run_options(arguments),
        )
    print(
        f"step {card['step']}, {card['samples_seen']} samples seen (each sample "
        f"{card['training']['uses']} times), {card['seconds']:.0f} s"
    )
    if "validation" in card:
        found = card["validation"]
        print(
            f"validation: {found['translation_cm']:.2f} ({found['translation_cm_median']:.2f}) cm, "
            f"{found['rotation_deg']:.1f} ({found['rotation_deg_median']:.1f}) deg, mean (median)"
        )
    return 0
