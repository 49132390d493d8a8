"""Reconstruction pictures: what is drawn, and refusals."""

import argparse
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from iga_drake.aligners.iga.local_encoder import ENCODER, DecoderConfig, EncoderConfig, OccupancyNet
from iga_drake.checkpoint import save_checkpoint
from iga_drake.dataset.occupancy import OccupancyConfig
from iga_drake.errors import IgaDrakeError
from iga_drake.studies.encoder_views import (
    COLUMNS,
    add_view_reconstruction,
    reconstruction_sheet,
    view_reconstruction,
)

MODEL = EncoderConfig(channels=8, scalars=8, layers=2, point_layers=1)
DECODER = DecoderConfig(width=8, blocks=1)


def network(bias: float) -> OccupancyNet:
    """A network that says all is free (bias < 0) or all is occupied."""
    net = OccupancyNet(MODEL, DECODER)
    with torch.no_grad():
        net.decoder.head.weight.zero_()
        net.decoder.head.bias.fill_(bias)
    return net


def pixels_like(tile: np.ndarray, channel: int) -> int:
    """Pixels in which one colour channel clearly leads."""
    others = np.delete(tile.astype(int), channel, axis=2).max(2)
    return int((tile[..., channel] > others + 60).sum())


@pytest.mark.parametrize("bias", [-1.0, 1.0])
def test_predictions_are_red_and_green(bias: float) -> None:
    sheet = reconstruction_sheet(
        network(bias), "train", [0], samples=OccupancyConfig(queries=400), in_box=2000, tile_px=160
    )
    assert sheet.shape == (160, 160 * COLUMNS, 3)
    cloud, queries, said, true = np.split(sheet, COLUMNS, axis=1)
    assert pixels_like(cloud, 2) > 100  # blue
    yellow = (cloud[..., 0] > 180) & (cloud[..., 1] > 140) & (cloud[..., 2] < 100)
    assert yellow.sum() > 30
    red, green = pixels_like(queries, 0), pixels_like(queries, 1)
    assert (red > 10 * green) if bias > 0 else (green > 100 and green > red)
    assert (pixels_like(said, 0) > 1000) == (bias > 0)
    assert pixels_like(true, 0) > 200


def test_the_command_writes_and_refuses(tmp_path: Path) -> None:
    weights = tmp_path / "encoder.safetensors"
    card = {"encoder": dataclasses.asdict(MODEL), "decoder": dataclasses.asdict(DECODER)}
    save_checkpoint(weights, network(1.0).state_dict(), kind=ENCODER, card=card)

    def run(*options: str) -> int:
        parser = argparse.ArgumentParser()
        add_view_reconstruction(parser)
        given = ["--weights", str(weights), "--png", str(tmp_path / "out.png"), *options]
        return view_reconstruction(parser.parse_args(given))

    assert run("--count", "1") == 0
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")
    for options, words in (
        (["--count", "0"], "--count 0"),
        (["--centres", "300"], "--centres 300"),
        (["--index", "1999", "--count", "2"], "cloud 2000 asked"),
        (["--png", str(tmp_path / "out.jpg")], "ends in .png"),
        (["--weights", str(tmp_path / "none.safetensors")], "no such checkpoint"),
    ):
        with pytest.raises(IgaDrakeError, match=words):
            run(*options)
