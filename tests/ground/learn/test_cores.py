"""Shards on the cores of this machine."""

from __future__ import annotations

import threading
import time

import pytest
from tests.waiting import MOST_S

from rendezview_ground.learn.jobs.cores import Cores

LONG_S = 0.5


class Shards:
    """Of two, one takes long: until the job is stopped, and a while more."""

    def __init__(self) -> None:
        self.begun, self.stopped, self.ended = (threading.Event() for _ in range(3))

    def compute(self, long: bool) -> None:
        if long:
            self.begun.set()
            assert self.stopped.wait(MOST_S)
            time.sleep(LONG_S)
            self.ended.set()
        else:
            assert self.begun.wait(MOST_S)


@pytest.mark.parametrize("stop", [KeyboardInterrupt, GeneratorExit])
def test_threads_are_waited_for_where_the_job_is_stopped(stop):
    shards = Shards()
    results = Cores(2).results(shards.compute, (), [(True,), (False,)])
    assert next(iter(results)) == (1, None)
    assert not shards.ended.is_set()
    shards.stopped.set()
    with pytest.raises(stop):
        results.throw(stop)
    assert shards.ended.is_set()


def test_threads_are_waited_for_where_a_shard_fails():
    shards = Shards()

    def task(long: bool) -> None:
        shards.compute(long)
        if not long:
            shards.stopped.set()
            raise ValueError("this shard")

    with pytest.raises(ValueError, match="this shard"):
        list(Cores(2).results(task, (), [(True,), (False,)]))
    assert shards.ended.is_set()
