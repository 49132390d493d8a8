"""Installs this project with some of its extras into the environment whose Python runs this.

Says first what is fetched and how much disk it takes; pip shows its progress. PyTorch comes as a
CPU build where pip finds one, at its own index or at `--cpu-index`. Needs pip alone:

    .venv/bin/python .ci/set_up.py --extras visuals
"""

import argparse
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

from pip._vendor.packaging.requirements import Requirement

# MB fetched and MB on disk, measured on Linux (x86_64), Python 3.11.
TORCH_SIZES = {"cpu": (200, 890), "cuda": (2700, 4700)}
BASE_SIZE = (140, 580)
EXTRA_SIZES = {
    "calibration": (55, 175),
    "cluster": (80, 250),
    "dev": (110, 520),
    "dif-net": (10, 20),
    "docs": (10, 30),
    "geometric": (5, 25),
    "icp": (130, 430),
    "meshes": (35, 65),
    "notebook": (10, 90),
    "realsense": (15, 38),
    "train": (20, 55),
    "visuals": (140, 440),
}
# Packages that only CUDA builds of PyTorch require.
CUDA_PREFIXES = ("nvidia-", "cuda-", "triton")


@dataclass(frozen=True)
class Build:
    """A build of PyTorch that pip would install."""

    version: str
    cuda: bool


def find_build(requirement: str, *options: str) -> Build | None:
    """The build that pip finds for a requirement, path or address; None where it finds none."""
    done = subprocess.run(
        [
            sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--no-deps",
            "--quiet", "--report", "-", *options, requirement,
        ],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    if done.returncode:
        return None
    metadata = json.loads(done.stdout)["install"][0]["metadata"]
    needed = [Requirement(text) for text in metadata.get("requires_dist", ())]
    cuda = any(
        each.name.lower().startswith(CUDA_PREFIXES)
        and (each.marker is None or each.marker.evaluate({"extra": ""}))
        for each in needed
    )
    return Build(metadata["version"], cuda)


def choose_torch(requirement: str, cpu_index: str) -> tuple[list[str], Build | None]:
    """Arguments for pip that install PyTorch, as a CPU build where there is one."""
    own = find_build(requirement)
    if (own is not None and not own.cuda) or not cpu_index:
        return [requirement], own
    there = ("--index-url", cpu_index, "--timeout", "20", "--retries", "1")
    other = find_build(requirement, *there)
    if other is None or other.cuda:
        return [requirement], own
    return [f"torch=={other.version}", "--extra-index-url", cpu_index], other


def installed_torch() -> str | None:
    """The version of PyTorch that is there; None without."""
    try:
        return version("torch")
    except PackageNotFoundError:
        return None


def notice(build: Build | None, extras: list[str]) -> str:
    """What is about to be fetched, in words."""
    parts = [("this project and what it needs", BASE_SIZE)]
    if build is not None:
        kind = "cuda" if build.cuda else "cpu"
        name = f"PyTorch {build.version}, {kind.upper()} build"
        parts.insert(0, (name, TORCH_SIZES[kind]))
    parts += [(f"extra '{name}'", EXTRA_SIZES[name]) for name in extras if name in EXTRA_SIZES]
    fetched, disk = (sum(size[k] for _, size in parts) for k in (0, 1))
    lines = [f"  {name:48} {a:>5} MB {b:>5} MB" for name, (a, b) in parts]
    what = "about" if build is not None else "at most, since a part of it is there"
    free = shutil.disk_usage(sys.prefix).free / 1e6
    return "\n".join(
        [
            f"Into {sys.prefix}, {what}:",
            f"  {'':48} fetched  on disk",
            *lines,
            f"  {'together':48} {fetched:>5} MB {disk:>5} MB   ({free:.0f} MB are free)",
        ]
    )


def main() -> int:
    """Installs PyTorch, then the project; returns pip's exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--extras", default="", help="of pyproject.toml, between commas")
    parser.add_argument("--torch", default="torch", help="requirement or wheel (default: torch)")
    parser.add_argument("--build", choices=("cpu", "cuda"), default="cpu", help="(default: cpu)")
    parser.add_argument("--cpu-index", default="", help="where CPU builds are, if not at pip's own")
    arguments = parser.parse_args()
    extras = [name for name in arguments.extras.split(",") if name]
    torch: list[str] = []
    build = None
    there = installed_torch()
    if there is None:
        index = arguments.cpu_index if arguments.build == "cpu" else ""
        torch, build = choose_torch(arguments.torch, index)
        if build is None:
            print(f"pip finds no {arguments.torch} for this Python", file=sys.stderr)
            return 1
    print(notice(build, extras), flush=True)
    if build is not None and build.cuda and arguments.build == "cpu":
        print(
            "pip finds no CPU build of PyTorch, so this is the one with NVIDIA's libraries. "
            "Another: make TORCH=WHEEL, or TORCH_CPU_INDEX=ADDRESS.",
            flush=True,
        )
    pip = [sys.executable, "-m", "pip", "install"]
    project = [f"-e.[{','.join(extras)}]" if extras else "-e."]
    for chosen in filter(None, (torch, project)):
        status = subprocess.run([*pip, *chosen]).returncode
        if status:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
