"""Contact sheets: which shape is in which tile, how large, in which colour."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydrake.systems.sensors import ImageIo

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.families import FAMILIES
from iga_drake.viewing.shape_sheets import (
    canonical_colors,
    contact_sheet,
    shape_sheet,
    write_png,
)

BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
RED, GREEN, BLUE = np.eye(3)


def ball(color: np.ndarray | None = None, radius: float = 0.05, centre=(0.0, 0.0, 0.0)):
    vertices = BALL.vertices * (radius / 0.05) + centre
    return vertices, BALL.faces, color if color is None else np.tile(color, (len(vertices), 1))


def drawn(image: np.ndarray) -> np.ndarray:
    return (image < 250).any(axis=2)


def test_shapes_lie_in_rows_and_fill_their_tiles() -> None:
    image = contact_sheet(
        [ball(RED), ball(GREEN, 0.2, (3.0, 0.0, 1.0)), ball(BLUE, 0.01)], columns=2, tile_px=100
    )
    assert image.shape == (200, 200, 3) and image.dtype == np.uint8
    tiles = image.reshape(2, 100, 2, 100, 3).swapaxes(1, 2).reshape(4, 100, 100, 3)
    assert [int(tile[50, 50].argmax()) for tile in tiles[:3]] == [0, 1, 2]
    for tile in tiles[:3]:  # a disc of 0.88 tiles across
        assert drawn(tile).mean() == pytest.approx(np.pi / 4 * 0.88**2, abs=0.02)
    assert not drawn(tiles[3]).any()


def test_one_scale_for_all_keeps_sizes_apart() -> None:
    image = contact_sheet([ball(), ball(radius=0.025)], columns=2, tile_px=80, same_scale=True)
    large, small = drawn(image[:, :80]).mean(), drawn(image[:, 80:]).mean()
    assert small / large == pytest.approx(0.25, abs=0.03)


def test_the_view_is_upright_with_x_to_the_right() -> None:
    place = np.array([(0.3, 0, 0), (-0.3, 0, 0), (0, 0, 0.3)])
    parts = [trimesh.Trimesh(*ball(centre=p)[:2]) for p in place]
    colors = np.concatenate([np.tile(c, (len(BALL.vertices), 1)) for c in (RED, GREEN, BLUE)])
    whole = trimesh.util.concatenate(parts)
    image = contact_sheet([(whole.vertices, whole.faces, colors)], columns=1, tile_px=120)
    found = [
        np.argwhere(drawn(image) & (image.argmax(axis=2) == channel)).mean(axis=0)
        for channel in range(3)
    ]
    assert found[0][1] > found[1][1] + 40  # +x right of -x
    assert found[2][0] < min(found[0][0], found[1][0]) - 20  # +z above


def test_parts_and_canonical_positions_are_told_by_colour() -> None:
    colors = canonical_colors(BALL.vertices)
    np.testing.assert_allclose([colors.min(axis=0), colors.max(axis=0)], [[0] * 3, [1] * 3])
    family = FAMILIES["mug"]
    sheet = shape_sheet(family.name, count=2, seed=1, columns=2, tile_px=100)
    assert sheet.shape == (100, 200, 3)
    # Wall, rim, inside and handle: hues are at least four groups.
    visible = sheet[drawn(sheet)].astype(float)
    share = (visible / visible.sum(axis=1, keepdims=True) * 12).round()
    groups, counts = np.unique(share, axis=0, return_counts=True)
    assert (counts > 30).sum() >= 4, groups


def test_png_files_hold_the_image(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    write_png(image, tmp_path / "new" / "sheet.png")
    read = ImageIo().Load(tmp_path / "new" / "sheet.png")
    np.testing.assert_array_equal(np.asarray(read.data)[..., :3], image)


def test_bad_input_is_named() -> None:
    with pytest.raises(ShapeError, match="0 shapes"):
        contact_sheet([])
    with pytest.raises(ShapeError, match=r"shapes\[0\]: colours \(4, 3\)"):
        contact_sheet([(BALL.vertices, BALL.faces, np.zeros((4, 3)))])
    with pytest.raises(ShapeError, match=r"unknown family 'mugg'.*mug"):
        shape_sheet("mugg")
