"""Pictures of an episode: one frame for each phase, from a camera beside the table."""

from pathlib import Path

import numpy as np
from pydrake.geometry import ClippingRange, ColorRenderCamera, RenderCameraCore
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from iga_drake.station.cameras.rgbd import RENDERER
from iga_drake.tasks.episode import Episode
from iga_drake.viewing.figures import new_figure, write_figure

_SIZE = (480, 360)  # px
_FIELD = 0.55  # rad, vertically
_DISTANCE, _HEIGHT = 0.85, 0.4  # m from the target, level and above it
_TURN = np.radians(60.0)  # about the target, from straight beyond it as the robot sees it
_COLUMNS = 4


class FrameStrip:
    """Frames of one episode, all from the same place: in front of the target, to the side."""

    def __init__(self, episode: Episode) -> None:
        self._episode = episode
        self._scene_graph = episode.robot.station.GetSubsystemByName("scene_graph")
        (target, *_) = episode.scene.with_role("target")
        middle = target.X_WO.translation() * [1, 1, 0] + [0, 0, 0.08]
        angle = np.arctan2(middle[1], middle[0]) + _TURN
        eye = middle + [_DISTANCE * np.cos(angle), _DISTANCE * np.sin(angle), _HEIGHT]
        forward = (middle - eye) / np.linalg.norm(middle - eye)
        right = np.cross(forward, [0.0, 0.0, 1.0]) / np.hypot(forward[0], forward[1])
        axes = np.column_stack([right, np.cross(forward, right), forward])
        self._X_WC = RigidTransform(RotationMatrix(axes), eye)
        self._frames: list[tuple[str, np.ndarray]] = []

    @property
    def frames(self) -> tuple[tuple[str, np.ndarray], ...]:
        """Caption and picture (height, width, 3), uint8, of each frame."""
        return tuple(self._frames)

    def add(self, caption: str) -> None:
        """Renders the scene as it is now."""
        graph = self._scene_graph
        context = graph.GetMyContextFromRoot(self._episode.simulator.get_context())
        core = RenderCameraCore(
            RENDERER, CameraInfo(*_SIZE, _FIELD), ClippingRange(0.01, 10.0), RigidTransform()
        )
        image = (
            graph.get_query_output_port()
            .Eval(context)
            .RenderColorImage(ColorRenderCamera(core), graph.world_frame_id(), self._X_WC)
        )
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
