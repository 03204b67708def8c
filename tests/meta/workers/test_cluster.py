"""A Ray cluster of several machines with one processor each, all of them on this one.

Ray gives each of them 30 seconds to start, which a machine with other work does not keep: these run
where RAY_CLUSTER is set, and not with all other tests.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from signal import SIGTERM, getsignal, signal
from typing import Any

import pytest
import ray
from ray.cluster_utils import Cluster

from proposer_rl.meta import workers as workers_module
from proposer_rl.meta.workers import WorkersError, WorkerSettings
from tests.meta.workers.test_workers import assert_near, cycles, make

pytestmark = pytest.mark.skipif("RAY_CLUSTER" not in os.environ, reason="needs an idle machine")
LIGHT = {"include_dashboard": False, "include_log_monitor": False}  # Ray gives a machine 30 s


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """A head without processors, so that any of the others may be lost."""
    found = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **LIGHT})
    yield found
    ray.shutdown()
    found.shutdown()


@pytest.fixture(autouse=True)
def two_machines(cluster: Cluster) -> Iterator[None]:
    """Each test begins with two."""
    for _ in range(2):
        cluster.add_node(num_cpus=1, **LIGHT)
    cluster.wait_for_nodes(timeout=600)
    yield
    for node in worker_machines(cluster):
        cluster.remove_node(node)


def settings(cluster: Cluster, cores: int = 1) -> WorkerSettings:
    return WorkerSettings("ray", 2, ["cpu"], cores, cluster.address)


def worker_machines(cluster: Cluster) -> list[Any]:
    return [node for node in cluster.list_all_nodes() if node is not cluster.head_node]


def test_machines_that_are_too_small_are_told_at_once(cluster: Cluster) -> None:
    """Together they have as many processors as are asked for, but no worker has two of one."""
    for _ in range(2):
        cluster.add_node(num_cpus=1, **LIGHT)
    cluster.wait_for_nodes(timeout=600)
    line = r"^workers=2: the Ray cluster has 4 CPU on 5 machines, each worker needs 2 CPU of"
    with pytest.raises(WorkersError, match=line):
        cycles(*make(settings(cluster, cores=2)))


def test_a_machine_that_is_lost_while_workers_begin_is_waited_for(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers_module, "SECONDS_TO_SAY", 2.0)
    monkeypatch.setattr(workers_module, "SECONDS_TO_START", 6.0)
    begin = workers_module._wait_for_all
    handler = signal(SIGTERM, lambda *_: None)
    ours = getsignal(SIGTERM)

    def lose_one_and_wait(collector: Any, *arguments: Any) -> None:
        assert getsignal(SIGTERM) is ours  # also while Ray is at work
        cluster.remove_node(worker_machines(cluster)[-1])
        begin(collector, *arguments)

    monkeypatch.setattr(workers_module, "_wait_for_all", lose_one_and_wait)
    try:
        with (
            pytest.warns(RuntimeWarning, match="workers=2 are waited for: the Ray cluster has 1"),
            pytest.raises(WorkersError, match=r"room for 1, after 6 s$"),
        ):
            cycles(*make(settings(cluster)))
        assert getsignal(SIGTERM) is ours
    finally:
        signal(SIGTERM, handler)


def test_machines_come_and_go_and_the_numbers_stay(cluster: Cluster) -> None:
    task, curriculum = make(settings(cluster))

    def one_goes_another_comes() -> None:
        with_a_worker = worker_machines(cluster)[0]  # of a set: after the other came, any of three
        cluster.add_node(num_cpus=1, **LIGHT)
        cluster.wait_for_nodes(timeout=600)
        cluster.remove_node(with_a_worker)

    try:
        with pytest.warns(RuntimeWarning, match="a worker was lost"):
            came = cycles(task, curriculum, between=one_goes_another_comes)
    finally:
        curriculum.close()
    assert_near(came, cycles(*make(None)))
