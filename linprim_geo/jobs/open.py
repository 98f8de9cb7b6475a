"""Selects the executor of tasks: processes of this machine, or Ray."""

from __future__ import annotations

from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.jobs.executor import Executor
from linprim_geo.jobs.processes import Processes


def open_executor(cluster: str | None, shared: Path, workers: int = 0) -> Executor:
    """Return an executor: processes of this machine without `cluster`, else Ray. "local" starts Ray here, an address
    joins the cluster there.

    Args:
        shared: a folder that all workers share.
        workers: the largest number at once; 0: as many as there are cores.

    Raises:
        LinprimError: Ray is not installed, or no cluster answers at the address.
    """
    if workers < 0:
        raise LinprimError(f"--workers is {workers}, wanted a number from 1, or 0 for one per core")
    if cluster is None:
        return Processes(shared, workers)
    from linprim_geo.jobs.ray_cluster import RayCluster

    return RayCluster(shared, cluster, workers)
