"""Pictures of the occupancy that the local encoder predicts, as in the paper.

`iga view reconstruction --png OUT` writes a row of pictures for each sample: the cloud (blue) with
its centres (yellow); the same with query points that the decoder says are occupied (red) and free
(green); all that it says is occupied of many queries all over the object's box; and all of these
that truly are.
"""

import argparse
import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import torch

from iga_drake.aligners.iga.local_encoder import OccupancyNet, load_encoder
from iga_drake.dataset.occupancy import OccupancyConfig, OccupancySample, make_occupancy_sample
from iga_drake.dataset.splits import sample_set
from iga_drake.files import output_file
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.paths import landed_weights
from iga_drake.progress import progress
from iga_drake.viewing.dataset_views import MOST_ROWS, ViewError, balls

BLUE, YELLOW = (0.25, 0.45, 0.9), (1.0, 0.85, 0.1)
RED, GREEN = (0.85, 0.15, 0.12), (0.2, 0.7, 0.25)
COLUMNS = 4
# Radii in units of the tile's largest extent.
_POINT, _CENTRE, _QUERY, _VOLUME = 0.010, 0.030, 0.013, 0.012
_SHOWN = 400  # queries of the second picture, this near the surface (m)
_NEAR = 0.03
_IN_BOX = 24_000  # queries of the third and the fourth
_CHUNK = 4000


def reconstruction_sheet(
    net: OccupancyNet,
    split: str,
    indices: list[int],
    *,
    centres: int = 8,
    samples: OccupancyConfig | None = None,
    in_box: int = _IN_BOX,
    tile_px: int = 320,
) -> np.ndarray:
    """(H, W, 3) uint8: a row of `COLUMNS` pictures for each sample of the set.

    Raises `ViewError` for no samples or too many.
    """
    from iga_drake.viewing.shape_sheets import contact_sheet

    if not 1 <= len(indices) <= MOST_ROWS:
        raise ViewError(f"reconstruction_sheet: {len(indices)} samples; 1 to {MOST_ROWS} fit")
    samples = samples or OccupancyConfig()
    box = dataclasses.replace(samples, queries=in_box, near=())
    tiles = []
    for index in progress(indices, "clouds"):
        beside = make_occupancy_sample(split, index, samples)
        uniform = make_occupancy_sample(split, index, box)  # of the same cloud
        chosen = furthest_point_sampling(torch.from_numpy(beside.points)[None], centres)
        cloud, places = beside.points, beside.points[chosen[0].numpy()]
        shown = beside.queries[beside.distance < _NEAR][:_SHOWN]
        occupied = predicted(net, beside, chosen, shown)
        said = uniform.queries[predicted(net, uniform, chosen, uniform.queries)]
        true = uniform.queries[uniform.distance < samples.shell]
        # Of balls in one place the first is drawn.
        object_ = [(places, _CENTRE, YELLOW), (cloud, _POINT, BLUE)]
        queries = [(shown[occupied], _QUERY, RED), (shown[~occupied], _QUERY, GREEN)]
        extent = float(np.ptp(np.concatenate((cloud, true)), axis=0).max())
        for groups in (
            object_,
            object_ + queries,
            [(places, _CENTRE, YELLOW), (said, _VOLUME, RED)],
            [(places, _CENTRE, YELLOW), (true, _VOLUME, RED)],
        ):
            tiles.append(
                balls(
                    np.concatenate([points for points, _, _ in groups]),
                    np.concatenate([np.full(len(p), extent * r) for p, r, _ in groups]),
                    np.concatenate([np.tile(c, (len(p), 1)) for p, _, c in groups]),
                )
            )
    return contact_sheet(tiles, columns=COLUMNS, tile_px=tile_px)


def predicted(
    net: OccupancyNet, sample: OccupancySample, index: torch.Tensor, queries: np.ndarray
) -> np.ndarray:
    """Predicted occupancy (Q,) bool of `queries` (Q, 3) (m).

    `index` (1, K) selects the points of the sample's cloud that are the encoder's centres.
    """
    with torch.no_grad():
        features = net.encoder(torch.from_numpy(sample.points)[None], index=index)
        logits = [
            net.decoder(features, torch.from_numpy(queries[k : k + _CHUNK])[None])[0]
            for k in range(0, len(queries), _CHUNK)
        ]
    return (torch.cat(logits) > 0).numpy()


def add_view_reconstruction(parser: argparse.ArgumentParser) -> None:
    """Options of `iga view reconstruction`."""
    parser.add_argument("--set", dest="split", default="unseen_categories", metavar="NAME")
    parser.add_argument("--index", type=int, default=0, help="the first cloud (default 0)")
    parser.add_argument("--count", type=int, default=6, help="how many clouds (default 6)")
    parser.add_argument("--centres", type=int, default=8, help="K (default 8, the paper's)")
    parser.add_argument("--weights", type=Path, help="default: the landed encoder")
    parser.add_argument(
        "--png", type=partial(output_file, suffix=".png"), required=True, metavar="OUT"
    )


def view_reconstruction(arguments: argparse.Namespace) -> int:
    """Runs `iga view reconstruction`; returns the exit status."""
    first, count, K = arguments.index, arguments.count, arguments.centres
    if first < 0 or count < 1 or not 1 <= K <= OccupancyConfig.cloud_points:
        raise ViewError(
            f"--index {first} --count {count} --centres {K}: at least 0, 1 and 1 are needed, and "
            f"at most {OccupancyConfig.cloud_points} centres"
        )
    limit = sample_set(arguments.split).count
    if limit is not None and first + count > 2 * limit:
        raise ViewError(
            f"--index: cloud {first + count - 1} asked of '{arguments.split}', it has {2 * limit}"
        )
    from iga_drake.viewing.shape_sheets import write_png

    weights = arguments.weights or landed_weights("encoder")
    net, _ = load_encoder(weights)
    indices = list(range(first, first + count))
    write_png(reconstruction_sheet(net, arguments.split, indices, centres=K), arguments.png)
    print(f"written: {arguments.png}")
    return 0
