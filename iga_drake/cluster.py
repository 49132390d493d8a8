"""Connects to a Ray cluster, which the extra `cluster` brings."""

from typing import Any

from iga_drake.errors import IgaDrakeError


class ClusterError(IgaDrakeError):
    """There is no Ray, or no cluster at the address."""


def connect_cluster(address: str | None) -> Any:
    """The module `ray`, connected to the cluster at an address; None: the local one, which is
    started if need be. A connection that there is already stays."""
    try:
        import ray
    except ImportError as error:
        raise ClusterError(f"{error}: pip install 'iga-drake[cluster]'") from error
    if not ray.is_initialized():
        try:
            ray.init(address=address, log_to_driver=False)
        except Exception as error:  # it raises many kinds
            raise ClusterError(
                f"Ray cluster '{address}': {error}; start one with `ray start --head`"
            ) from error
    return ray
