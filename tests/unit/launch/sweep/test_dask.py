"""The same sweep on a Dask cluster, with processes and a loopback network."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.sweeping import results, short_road, sweep

distributed = pytest.importorskip(
    "distributed", reason="the extra `dask` is not installed: there is no cluster to sweep on"
)


@pytest.mark.slow
@pytest.mark.more
def test_a_cluster_has_the_same_results(tmp_path: Path) -> None:
    scenario = short_road(tmp_path)
    lists = ("--volumes", "1600", "--seeds", "3:5")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, host="127.0.0.1", dashboard_address="127.0.0.1:0"
    ) as cluster:
        done = sweep(scenario, tmp_path / "cluster", *lists, "--dask", cluster.scheduler_address)
    assert done.returncode == 0, done.stderr
    assert sweep(scenario, tmp_path / "here", *lists, "--jobs", 2).returncode == 0
    assert results(tmp_path / "cluster") == results(tmp_path / "here")
    files = [
        {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
        for out in (tmp_path / "cluster", tmp_path / "here")
    ]
    assert files[0] == files[1]
