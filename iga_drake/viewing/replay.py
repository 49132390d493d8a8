"""Pictures of an episode and of demonstrations, in Meshcat and as pages that need no server."""

import base64
import gzip
import importlib.resources
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Cylinder, Meshcat, MeshcatParams, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.perception import BaseField, Fields, PointCloud

from iga_drake.demonstrations.demonstration import DemonstrationSet
from iga_drake.files import write_text

TARGET_COLOR = Rgba(0.10, 0.62, 0.95, 1.0)
GRASPED_COLOR = Rgba(0.95, 0.55, 0.10, 1.0)
PREDICTED_COLOR = Rgba(0.45, 0.85, 0.15, 1.0)
OTHER_MODE_COLOR = Rgba(0.45, 0.35, 0.60, 1.0)
PATH_COLOR = Rgba(0.85, 0.15, 0.45, 1.0)
_FRAME_RATE = 16.0  # of recordings, 1/s: a page goes smoothly from one to the next
EXPERT_COLOR = Rgba(0.95, 0.80, 0.10, 1.0)


def _css(color: Rgba) -> str:
    return "#" + "".join(f"{round(255 * c):02x}" for c in (color.r(), color.g(), color.b()))


# What the colours of an episode's page mean.
LEGEND = [
    [words, _css(color)]
    for words, color in (
        ("target, observed", TARGET_COLOR),
        ("grasped, observed", GRASPED_COLOR),
        ("chosen pose, grasped carried there", PREDICTED_COLOR),
        ("hand at the other modes", OTHER_MODE_COLOR),
        ("way ahead", PATH_COLOR),
        ("expert's pose (at the end)", EXPERT_COLOR),
        ("contact forces, 5 cm for 10 N", Rgba(1.0, 0.0, 0.0)),
    )
]


def quiet_meshcat() -> Meshcat:
    """A Meshcat on this machine's own address alone."""
    return Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))


def show_cloud(
    meshcat: Meshcat, path: str, points: np.ndarray, color: Rgba, size: float = 0.004
) -> None:
    """Shows `points` (P, 3) (m); an empty cloud removes what was shown there."""
    meshcat.Delete(path)
    if len(points) == 0:
        return
    cloud = PointCloud(new_size=len(points), fields=Fields(BaseField.kXYZs))
    cloud.mutable_xyzs()[:] = np.asarray(points, dtype=np.float32).T
    meshcat.SetObject(path, cloud, size, color)


def show_triad(meshcat: Meshcat, path: str, X_WF: RigidTransform, length: float = 0.1) -> None:
    """Shows a frame: x red, y green, z blue."""
    about = {"x": RotationMatrix.MakeYRotation(np.pi / 2), "y": RotationMatrix.MakeXRotation(
        -np.pi / 2), "z": RotationMatrix()}  # fmt: skip
    for axis, (name, R) in enumerate(about.items()):
        p = np.zeros(3)
        p[axis] = length / 2
        color = np.zeros(3)
        color[axis] = 0.9
        meshcat.SetObject(f"{path}/{name}", Cylinder(0.025 * length, length), Rgba(*color, 1.0))
        meshcat.SetTransform(f"{path}/{name}", RigidTransform(R, p))
    meshcat.SetTransform(path, X_WF)


def begin_recording(meshcat: Meshcat, *, live: bool) -> None:
    """Records from now on, and forgets what was recorded before; `live`: it is seen as well."""
    meshcat.DeleteRecording()
    meshcat.StartRecording(frames_per_second=_FRAME_RATE, set_visualizations_while_recording=live)


def end_recording(meshcat: Meshcat) -> None:
    """Ends the recording and gives it to the page, which doesn't play it unasked."""
    meshcat.StopRecording()
    meshcat.get_mutable_recording().set_autoplay(False)
    meshcat.PublishRecording()


def replay_html(meshcat: Meshcat, episode: Mapping[str, Any], poster: bytes | None = None) -> str:
    """A page that needs no server: the recording of an episode, with its verdict and errors, a
    legend, and a time line of its phases to move along.

    Args:
      meshcat: holds the published recording.
      episode: plain JSON values, as `EpisodeResult.row` gives them.
      poster: a JPEG that is seen until the browser has drawn the recording, as
        `replay_poster` renders it.
    """
    meshcat.Flush()
    page = meshcat.StaticHtml()
    data = json.dumps({**episode, "legend": LEGEND}).replace("</", "<\\/")
    overlay = importlib.resources.files(__package__).joinpath("timeline.html").read_text("utf-8")
    head, body, rest = page.rpartition("</body>")
    data = f'<script type="application/json" id="episode">{data}</script>'
    return packed_page("\n".join((head, data, overlay, body + rest)), poster)


def packed_page(page: str, poster: bytes | None = None) -> str:
    """A page that unpacks itself into `page` when it is opened, of about half its size. Until
    `page` removes the element "iga-poster", the picture `poster` (JPEG) lies over it, as high as
    the window."""
    packed = base64.b64encode(gzip.compress(page.encode(), compresslevel=6, mtime=0)).decode()
    shown = ""
    if poster is not None:
        shown = _POSTER.replace("JPEG", base64.b64encode(poster).decode())
    return _UNPACKING.replace("POSTER", shown).replace("PACKED", packed)


_POSTER = """<img id="iga-poster" alt="" src="data:image/jpeg;base64,JPEG" style="position: fixed;
  z-index: 4; top: 0; height: 100vh; left: 50%; transform: translateX(-50%)">
"""


_UNPACKING = """<!doctype html>
<html><head><meta charset="utf-8"></head><body style="margin: 0">
POSTER<script type="text/plain" id="packed">PACKED</script>
<script>
(async () => {
  if (typeof DecompressionStream === "undefined") {
    document.body.textContent = "This page needs a browser of 2023 or newer.";
    return;
  }
  const packed = document.getElementById("packed").textContent;
  const bytes = (await fetch("data:application/gzip;base64," + packed)).body;
  const page = await new Response(bytes.pipeThrough(new DecompressionStream("gzip"))).text();
  const poster = document.getElementById("iga-poster");
  if (poster) {  // is on the screen before the work begins; a hidden page draws no frames
    await poster.decode();
    const frame = () => new Promise(requestAnimationFrame);
    await Promise.race([frame().then(frame), new Promise((done) => setTimeout(done, 500))]);
  }
  document.open();
  document.write(page);
  document.close();
  if (poster) document.body.append(poster);
})();
</script></body></html>
"""


def show_demonstrations(
    meshcat: Meshcat, demonstrations: DemonstrationSet, spacing: float = 0.6
) -> None:
    """Shows each demonstration beside the other, along y: for each waypoint the frame that the end
    effector went to, the cloud that it carried there, and the cloud that stood there."""
    meshcat.SetCameraPose(np.array([2.3, 0.0, 1.0]), np.array([0.5, 0.0, 0.0]))
    for index, demonstration in enumerate(demonstrations.demonstrations):
        root = f"demonstrations/{index}"
        for k, waypoint in enumerate(demonstration.waypoints):
            alignment = demonstration.alignment(k)
            at = f"{root}/{waypoint.name}"
            show_cloud(meshcat, f"{at}/{waypoint.target}", alignment.target, TARGET_COLOR)
            show_cloud(meshcat, f"{at}/{waypoint.grasped}", alignment.grasped, GRASPED_COLOR)
            show_triad(meshcat, f"{at}/X_WE", RigidTransform(waypoint.X_WE), length=0.06)
        if demonstration.trajectory is not None:
            path = demonstration.trajectory.X_WE[:, :3, 3].T
            meshcat.SetLine(f"{root}/trajectory of E", path, 2.0, GRASPED_COLOR)
        middle = (len(demonstrations) - 1) / 2
        meshcat.SetTransform(root, RigidTransform([0.0, spacing * (index - middle), 0.0]))


def demonstrations_html(demonstrations: DemonstrationSet) -> str:
    """A page with all demonstrations."""
    meshcat = quiet_meshcat()
    show_demonstrations(meshcat, demonstrations)
    meshcat.Flush()
    return meshcat.StaticHtml()


def write_or_serve(meshcat: Meshcat, html: Path | None) -> None:
    """Writes what is shown as a page, or prints its address and serves until Enter is pressed."""
    if html is not None:
        meshcat.Flush()
        write_text(html, meshcat.StaticHtml())
        print(f"written: {html}")
        return
    print(f"open {meshcat.web_url()} in a browser; press Enter to end", flush=True)
    try:
        input()
    except EOFError:
        pass


def serve_demonstrations(demonstrations: DemonstrationSet) -> None:
    """Shows all demonstrations at an address that is printed, until Enter is pressed."""
    meshcat = quiet_meshcat()
    show_demonstrations(meshcat, demonstrations)
    write_or_serve(meshcat, None)
