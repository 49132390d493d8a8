"""Pictures of an episode: one frame for each phase, and the start as a replay's page shows it."""

from pathlib import Path

import numpy as np
from pydrake.geometry import ClippingRange, ColorRenderCamera, RenderCameraCore
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo, ImageFileFormat, ImageIo, ImageRgba8U

from iga_drake.station.cameras.rgbd import RENDERER, look_at
from iga_drake.tasks.episode import Episode
from iga_drake.viewing.figures import new_figure, write_figure
from iga_drake.viewing.meshcat import VIEW_EYE, VIEW_FIELD, VIEW_TARGET

_SIZE = (480, 360)  # px
_FIELD = 0.55  # rad, vertically
_DISTANCE, _HEIGHT = 0.85, 0.4  # m from the target, level and above it
_TURN = np.radians(60.0)  # about the target, from straight beyond it as the robot sees it
_COLUMNS = 4
_POSTER_SIZE = (1680, 720)  # px: wider than most windows, which cut its sides off


class FrameStrip:
    """Frames of one episode, all from the same place: in front of the target, to the side."""

    def __init__(self, episode: Episode) -> None:
        self._episode = episode
        (target, *_) = episode.scene.with_role("target")
        middle = target.X_WO.translation() * [1, 1, 0] + [0, 0, 0.08]
        angle = np.arctan2(middle[1], middle[0]) + _TURN
        eye = middle + [_DISTANCE * np.cos(angle), _DISTANCE * np.sin(angle), _HEIGHT]
        self._X_WC = look_at(eye, middle)
        self._frames: list[tuple[str, np.ndarray]] = []

    @property
    def frames(self) -> tuple[tuple[str, np.ndarray], ...]:
        """Caption and picture (height, width, 3), uint8, of each frame."""
        return tuple(self._frames)

    def add(self, caption: str) -> None:
        """Renders the scene as it is now."""
        image = _rendered(self._episode, self._X_WC, _SIZE, _FIELD)
        self._frames.append((caption, np.array(image.data)[:, :, :3]))

    def write(self, path: Path) -> None:
        """Writes the frames as one PNG file, row by row."""
        rows = -(-len(self._frames) // _COLUMNS)
        figure, panels = new_figure(rows, _COLUMNS)
        for panel in panels:
            panel.set_axis_off()
        for panel, (caption, picture) in zip(panels, self._frames, strict=False):
            panel.imshow(picture)
            panel.set_title(caption, fontsize=8)
        write_figure(figure, path)


def replay_poster(episode: Episode) -> bytes:
    """The scene as it is now, from where Meshcat's camera is (`start_meshcat`): a JPEG."""
    X_WC = look_at(np.array(VIEW_EYE), np.array(VIEW_TARGET))
    image = _rendered(episode, X_WC, _POSTER_SIZE, np.radians(VIEW_FIELD))
    return bytes(ImageIo().Save(image, ImageFileFormat.kJpeg))


def _rendered(
    episode: Episode, X_WC: RigidTransform, size: tuple[int, int], field: float
) -> ImageRgba8U:
    """The scene of a simulated station as a camera of `size` (px) and vertical `field` (rad) sees
    it now."""
    graph = episode.robot.station.GetSubsystemByName("scene_graph")
    context = graph.GetMyContextFromRoot(episode.simulator.get_context())
    core = RenderCameraCore(
        RENDERER, CameraInfo(*size, field), ClippingRange(0.01, 10.0), RigidTransform()
    )
    return (
        graph.get_query_output_port()
        .Eval(context)
        .RenderColorImage(ColorRenderCamera(core), graph.world_frame_id(), X_WC)
    )
