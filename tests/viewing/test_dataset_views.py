"""Views of samples: the same alignment looks the same in every column, and files are written."""

import argparse
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from iga_drake.dataset.samples import Sample
from iga_drake.errors import IgaDrakeError
from iga_drake.viewing import dataset_views
from iga_drake.viewing.dataset_views import (
    MOST_ROWS,
    ROLE_COLORS,
    ViewError,
    add_view_dataset,
    pair_names,
    point_colors,
    sample_sheet,
    show_samples,
    turned_pairs,
    view_dataset,
)
from iga_drake.viewing.replay import quiet_meshcat

PAIRS, POINTS = 3, 40


def rigid_sample(seed: int, *, modes: int = 1) -> Sample:
    """A sample whose instances are the canonical ones, each pair in a frame of its own."""
    rng = np.random.default_rng(seed)
    canonical = rng.uniform(-0.5, 0.5, (2, POINTS, 3))
    pair = 0.2 * canonical
    pair[0] += [0.1, 0.0, 0.0]  # A beside B
    points = np.empty((2, PAIRS, POINTS, 3), np.float32)
    for n in range(PAIRS):
        R = Rotation.random(random_state=seed + n).as_matrix()
        points[:, n] = pair @ R.T + rng.normal(size=3)
    return Sample(
        points=points,
        canonical=np.repeat(canonical[:, None], PAIRS, axis=1).astype(np.float32),
        aligned=np.repeat(rng.random((2, 1, POINTS)) < 0.3, PAIRS, axis=1),
        present=np.ones((2, PAIRS, POINTS), bool),
        up=np.zeros((2, PAIRS, 3), np.float32),
        size=np.full((2, PAIRS), 0.2, np.float32),
        mode=np.arange(PAIRS) % modes,
        modes=np.eye(4)[None],
        axes=np.zeros((2, 2, 3)),
        category=("hammer", "mug"),
    )


@pytest.mark.parametrize("seed", range(5))
def test_every_pair_is_turned_to_b_s_canonical_instance(seed: int):
    sample = rigid_sample(seed)
    turned = turned_pairs(sample)
    for n in range(PAIRS):
        np.testing.assert_allclose(turned[:, n], turned[:, 0], atol=1e-5)
    shift = turned[1, 0] - 0.2 * sample.canonical[1, 0]
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-5)
    both = turned[:, 0].reshape(-1, 3)
    np.testing.assert_allclose(both.min(axis=0), -both.max(axis=0), atol=1e-6)


def test_deformation_away_from_the_aligned_part_hardly_turns_a_pair():
    sample = rigid_sample(3)
    still = turned_pairs(sample)
    away = ~sample.aligned[1, 1]
    sample.points[1, 1, away] += 0.03 * np.random.default_rng(0).normal(size=(away.sum(), 3))
    moved = turned_pairs(sample)
    part = sample.aligned[1, 1]
    before, after = (p - p.mean(axis=0) for p in (still[1, 1, part], moved[1, 1, part]))
    assert np.abs(after - before).max() < 0.002


def test_colours_tell_roles_and_the_aligned_part():
    sample = rigid_sample(0)
    colors = point_colors(sample, "roles")
    for role in range(2):
        for part in (False, True):
            own = colors[role][sample.aligned[role] == part]
            assert (own == ROLE_COLORS[role, int(part)]).all()
    green, red = ROLE_COLORS[0], ROLE_COLORS[1]
    assert (green.argmax(axis=1) == 1).all() and (red.argmax(axis=1) == 0).all()


def test_correspondence_colours_are_the_same_at_the_same_place():
    sample = rigid_sample(0)
    colors = point_colors(sample, "correspondence")
    np.testing.assert_allclose(colors[:, 1:], colors[:, :-1])
    assert colors.min() == 0.0 and colors.max() == 1.0
    # Linear in the canonical position: differences along one axis keep their ratios.
    x, red = sample.canonical[0, 0, :, 0], colors[0, 0, :, 0]
    np.testing.assert_allclose(red, (x - x.min()) / np.ptp(x), atol=1e-6)


def test_the_test_pair_is_last_and_modes_are_named_where_there_are_several():
    assert pair_names(rigid_sample(0)) == ["demonstration 0", "demonstration 1", "test"]
    assert pair_names(rigid_sample(0, modes=2))[1:] == ["demonstration 1 (mode 1)", "test (mode 0)"]


def test_a_sheet_shows_the_same_picture_in_every_column_of_a_rigid_sample():
    tile = 80
    sheet = sample_sheet([rigid_sample(0), rigid_sample(1)], tile_px=tile)
    assert sheet.shape == (2 * tile, PAIRS * tile, 3)
    tiles = sheet.reshape(2, tile, PAIRS, tile, 3).transpose(0, 2, 1, 3, 4).astype(int)
    # Means over blocks of a tenth of the tile: columns are seen from directions 2 degrees apart.
    blocks = tiles.reshape(2, PAIRS, 10, tile // 10, 10, tile // 10, 3).mean(axis=(3, 5))
    inside = np.abs(blocks - blocks[:, :1]).max(axis=-1).mean()
    between = np.abs(blocks[0] - blocks[1]).max(axis=-1).mean()
    assert inside < 0.3 * between, (inside, between)
    red, green, blue = np.moveaxis(tiles[0, 0], -1, 0)
    assert ((red > green + 30) & (red > blue + 30)).mean() > 0.003  # B is in the picture
    assert ((green > red + 20) & (green > blue + 20)).mean() > 0.003  # and A


def test_sheets_refuse_what_does_not_fit():
    with pytest.raises(ViewError, match="0 samples"):
        sample_sheet([])
    with pytest.raises(ViewError, match=f"1 to {MOST_ROWS} samples"):
        sample_sheet([rigid_sample(0)] * (MOST_ROWS + 1))


def test_meshcat_shows_every_pair_side_by_side():
    meshcat = quiet_meshcat()
    show_samples(meshcat, [rigid_sample(0), rigid_sample(1)], first=7)
    places = {}
    for row in (7, 8):
        for n, name in enumerate(["demonstration 0", "demonstration 1", "test"]):
            path = f"/drake/samples/{row}/{n} {name}"
            for part in ("A hammer/rest", "A hammer/aligned part", "B mug/aligned part"):
                assert meshcat.HasPath(f"{path}/{part}")
            assert meshcat.HasPath(f"{path}/B mug/rest")
            places[row, n] = path
    show_samples(meshcat, [rigid_sample(2)])
    assert not meshcat.HasPath(places[7, 0])


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    add_view_dataset(parser)
    return view_dataset(parser.parse_args(arguments))


def test_the_command_writes_a_page_and_a_sheet(tmp_path: Path, capsys: pytest.CaptureFixture):
    png, page = tmp_path / "new" / "sheet.png", tmp_path / "new" / "page.html"
    assert run("--set", "train", "--index", "3", "--png", str(png), "--html", str(page)) == 0
    assert png.read_bytes().startswith(b"\x89PNG")
    assert page.read_text().lstrip().lower().startswith("<!doctype html>")
    printed = capsys.readouterr().out
    assert printed.startswith("train 3: A ") and "test" in printed
    assert f"written: {png}" in printed and f"written: {page}" in printed


def test_the_command_takes_consecutive_samples(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    asked = []

    def sample(split: str, index: int, config: object) -> Sample:
        asked.append((split, index))
        return rigid_sample(index)

    monkeypatch.setattr(dataset_views, "make_sample", sample)
    page = tmp_path / "page.html"
    assert run("--set", "easy", "--index", "998", "--count", "2", "--html", str(page)) == 0
    assert asked == [("easy", 998), ("easy", 999)]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--set", "nothing"], "train"),
        (["--index", "-1"], "at least 0"),
        (["--count", "0"], "at least"),
        (["--set", "easy", "--index", "999", "--count", "2"], "sample 1000 asked of 'easy'"),
        (["--png", "sheet.jpg"], r"\.png"),
        (["--png", "sheet.png", "--count", "31"], "write several"),
    ],
)
def test_bad_input_is_refused_before_any_work(options: list[str], words: str):
    with pytest.raises(IgaDrakeError, match=words):
        run(*options)
