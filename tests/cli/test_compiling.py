"""Loops are compiled ahead: the list of them is right, and so is what is said."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest
from numba import njit, typeof
from numba.core.caching import IndexDataCacheFile
from numba.core.event import install_listener
from tests.waiting import MOST_S

from experiments.startup.recorded import recorded
from rendezview.cli import compiling
from rendezview.cli import warm as warm_command
from rendezview.cli.main import main
from rendezview.errors import RendezviewError
from rendezview.sensors.appearance.model.view_tables import ViewTables


@pytest.mark.parametrize(
    "argument",
    [
        1,
        2.5,
        True,
        np.zeros((3, 4)),
        np.zeros((2, 3), np.uint8)[:, ::2],
        np.frombuffer(b"abc", np.uint8),
        (np.zeros(12), False),
        ViewTables(*[np.zeros(3)] * 9, 1.0, 2.0, 3.0),
    ],
)
def test_types_of_arguments_survive_json(argument):
    kind = typeof(argument)
    assert compiling.type_from_json(json.loads(json.dumps(compiling.type_to_json(kind)))) == kind


def test_an_argument_that_no_loop_takes_is_an_error():
    with pytest.raises(TypeError, match="unicode"):
        compiling.type_to_json(typeof("text"))


@pytest.mark.parametrize(
    ("command", "least"),
    [("track", 20), ("train", 20), ("demo", 20), ("serve", 60), ("reflectors", 15), ("stereo", 6)],
)
def test_listed_loops_exist_and_take_their_arguments(command, least):
    groups = compiling.COMMANDS[command]
    entries = [entry for group in groups for entry in compiling.load_loops(group)]
    assert len(entries) > least
    for entry in entries:
        loop = compiling._named(entry["loop"])
        assert len(loop.py_func.__code__.co_varnames) >= len(entry["arguments"])
        for argument in entry["arguments"]:
            kind = compiling.type_from_json(argument)
            assert compiling.type_to_json(kind) == argument


def test_a_listed_loop_is_cached_when_it_is_compiled():
    entry = compiling.load_loops("track")[-1]
    loop = compiling._named(entry["loop"])
    loop.compile(tuple(map(compiling.type_from_json, entry["arguments"])))
    assert compiling._is_cached(loop)
    # A copy of the same source is newer than the cache, which holds all the same.
    for index in Path(loop.stats.cache_path).glob(f"*{loop.py_func.__qualname__}-*.nbi"):
        os.utime(index, (0, 0))
    assert compiling._is_cached(loop)


def test_a_cache_of_a_version_with_other_types_is_compiled_again(tmp_path):
    file = IndexDataCacheFile(str(tmp_path), "loop", "stamp")
    index = tmp_path / "loop.nbi"
    index.write_bytes(pickle.dumps(numba.__version__) + b"crendezview.no_longer_here\nTables\n.")
    with pytest.raises(ModuleNotFoundError):
        file._load_index()
    loop = SimpleNamespace(
        stats=SimpleNamespace(cache_path=str(tmp_path)), _cache=SimpleNamespace(_cache_file=file)
    )
    assert not compiling._is_cached(loop)
    assert not index.exists()
    assert file._load_index() == {}


def test_a_loop_that_has_changed_does_not_keep_others_from_being_compiled(monkeypatch):
    last = compiling.load_loops("track")[-1]
    compiled = []
    wrong = [last | {"loop": "rendezview.geometry.so3:gone"}, last | {"arguments": ["int64"] * 9}]

    class Loop:
        def __init__(self, name: str) -> None:
            self._loop = named(name)

        def compile(self, arguments: tuple) -> None:
            self._loop.compile(arguments)
            compiled.append(arguments)

    named = compiling._named
    monkeypatch.setattr(compiling, "_named", Loop)
    compiling._compile([*wrong, last])
    assert len(compiled) == 1


def test_a_share_begins_with_what_is_short_and_holds_all_versions_of_a_loop():
    named = [("a", 5.0), ("b", 4.0), ("a", 3.0), ("c", 1.0), ("d", 6.0)]
    entries = [{"loop": loop, "seconds": s} for loop, s in named]
    first, second = compiling._shares(entries, 2)
    assert [(e["loop"], e["seconds"]) for e in first] == [("b", 4.0), ("d", 6.0)]
    assert [(e["loop"], e["seconds"]) for e in second] == [("c", 1.0), ("a", 3.0), ("a", 5.0)]
    assert len(compiling._shares(entries, 9)) == 4


@pytest.fixture
def small_loops(tmp_path) -> dict[str, str]:
    """An environment where a module ``small`` has two loops, and nothing is compiled."""
    loop = "@njit(cache=True)\ndef {}(x):\n    return {} * x\n\n"
    text = "from numba import njit\n\n" + loop.format("twice", 2) + loop.format("thrice", 3)
    (tmp_path / "small.py").write_text(text)
    places = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    return os.environ | {"PYTHONPATH": places, "NUMBA_CACHE_DIR": str(tmp_path / "c")}


def test_processes_that_save_versions_of_one_loop_at_once_lose_none(tmp_path, small_loops):
    kinds = ["int32", "int64", "float32", "float64", "uint8", "uint16"]
    workers = [
        subprocess.Popen(
            [sys.executable, "-m", "rendezview.cli.compiling",
             json.dumps([{"loop": "small:twice", "arguments": [kind]} for kind in some])],
            env=small_loops,
        )
        for some in (kinds[::2], kinds[1::2])
    ]  # fmt: skip
    assert [worker.wait(MOST_S) for worker in workers] == [0, 0]
    (index,) = (tmp_path / "c").rglob("small.twice*.nbi")
    with index.open("rb") as file:
        pickle.load(file)
        _, versions = pickle.loads(file.read())
    assert len(versions) == len(set(versions.values())) == len(kinds)


def test_missing_loops_are_compiled_in_processes_and_a_line_says_so(monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(compiling, "say", said.append)
    entries = [e | {"seconds": 1.0} for e in compiling.load_loops("track")[-5:]]
    started = []

    class Process(subprocess.Popen):
        def __init__(self, command, **options):
            started.append(json.loads(command[-1]))
            super().__init__(command, **options)

    monkeypatch.setattr(compiling, "load_loops", lambda group: entries)
    monkeypatch.setattr(compiling, "_is_cached", lambda loop: False)
    monkeypatch.setattr(compiling, "_cores", lambda: 2)
    monkeypatch.setattr(subprocess, "Popen", Process)
    compiled = []
    monkeypatch.setattr(compiling, "_compile", lambda share, done: compiled.append(share))
    compiling.compile_ahead("track")
    assert said[0].startswith("Compiling 5 loops for this machine in 2 processes")
    assert said[1].startswith("Compiled in")
    here = [e for share in compiled for e in share]
    there = [e for share in started for e in share]
    assert here
    assert there
    assert sorted(e["loop"] for e in here + there) == sorted(e["loop"] for e in entries)
    entries = [entry | {"seconds": 0.1} for entry in entries]
    compiling.compile_ahead("track")  # too little for a process of its own
    monkeypatch.setattr(compiling, "_is_cached", lambda loop: True)
    compiling.compile_ahead("track", "train")
    assert len(said) == 2


def test_loops_are_counted_with_the_time_that_is_left(monkeypatch):
    """By this machine's own speed, of all processes together."""
    told: list[tuple[str, int, int, float]] = []
    monkeypatch.setattr(compiling, "_START_S", 0.5)
    monkeypatch.setattr(compiling, "_EACH_S", 0.0)
    now = iter([100.0, *(100.0 + 8.0 * k for k in range(1, 9))])
    monkeypatch.setattr(time, "perf_counter", lambda: next(now))
    loops = [{"seconds": 4.0}, {"seconds": 1.0}, {"seconds": 3.0}]
    counter = compiling._Counter(loops, 2, lambda *step: told.append(step))
    counter(1.0)
    program = "print(3.0)\nprint(4.0)"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        counter.follow(process)
    assert told == [
        ("compile", 1, 3, pytest.approx(28.0)),  # 8 s for start and loop, two of nine
        ("compile", 2, 3, pytest.approx(12.8)),
        ("compile", 3, 3, 0.0),
    ]


def test_a_loop_of_several_groups_is_compiled_once(monkeypatch):
    entries = [e | {"seconds": 3.0} for e in compiling.load_loops("track")[-3:]]
    monkeypatch.setattr(compiling, "load_loops", lambda group: entries)
    monkeypatch.setattr(compiling, "_is_cached", lambda loop: False)
    assert compiling._missing(["track", "serve"]) == entries


def test_a_machine_is_warmed_for_the_commands_that_are_named(monkeypatch):
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(warm_command, "compile_ahead", lambda *groups: asked.append(groups))
    warm_command.warm(["track"])
    warm_command.warm(None)
    assert asked[0] == ("track", "hard")
    assert set(asked[1]) == set(compiling.GROUPS)
    with pytest.raises(RendezviewError, match="name track, train"):
        warm_command.warm(["trak"])


@pytest.mark.parametrize("command", ["doctor", "simulate", "evaluate", "assess", "show", "track"])
def test_no_command_compiles_silently(monkeypatch, command):
    told: list[bool] = []
    monkeypatch.setattr(compiling, "tell_of_compiling", lambda: told.append(True))
    monkeypatch.setattr(sys, "argv", ["rendezview", command, "--no-such-option"])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert told == [True]


def test_a_loop_that_is_compiled_unexpectedly_is_announced_once(monkeypatch):
    njit(lambda x: x)(1)  # commands that other tests have called in this process say it now
    said: list[str] = []
    listeners: list[compiling.Compiling] = []
    monkeypatch.setattr(compiling, "say", said.append)
    monkeypatch.setattr(compiling, "register", lambda _, listener: listeners.append(listener))
    compiling.tell_of_compiling()

    def work() -> None:
        njit(lambda x: x + 1)(1)
        njit(lambda x: x + 2)(1)

    with install_listener("numba:compile", *listeners):
        monkeypatch.setattr(compiling, "_named", lambda name: njit(lambda x: x - 1))
        compiling._compile([{"loop": "one", "arguments": ["int64"], "seconds": 1.0}])
        assert said == []  # that is announced before
        work()
    assert len(said) == 1
    entries = recorded(lambda: njit(lambda x: 2.0 * x)(1))
    assert [entry["arguments"] for entry in entries] == [["int64"]]


def test_loops_are_compiled_beside_the_work_and_waited_for(small_loops):
    """In a process of its own, which compiles none of them."""
    program = """
from rendezview.cli import compiling
spoken = []
compiling.say = spoken.append
names = ("small:twice", "small:thrice")
few = [{"loop": name, "arguments": ["int64"], "seconds": 4.0} for name in names]
compiling.load_loops = lambda group: few
loops = [compiling._named(entry["loop"]) for entry in few]
assert not any(compiling._is_cached(loop) for loop in loops)
with compiling.compile_beside("demo") as beside:
    assert beside.is_busy
    beside.wait()
    assert not beside.is_busy and all(compiling._is_cached(loop) for loop in loops)
    beside.wait()
assert not any(loop.overloads for loop in loops)  # not here
assert len(spoken) == 1 and "the last of" in spoken[0], spoken
with compiling.compile_beside("demo") as beside:
    beside.wait()
assert len(spoken) == 1, spoken
"""
    subprocess.run([sys.executable, "-c", program], env=small_loops, check=True, timeout=MOST_S)


def test_what_is_compiled_beside_ends_with_the_work(monkeypatch):
    entries = [e for e in compiling.load_loops("demo") if e["seconds"]]
    monkeypatch.setattr(compiling, "_missing", lambda groups: entries)
    started = []
    begin = compiling._worker

    def noted(*arguments):
        started.append(begin(*arguments))
        return started[-1]

    monkeypatch.setattr(compiling, "_worker", noted)
    with pytest.raises(ZeroDivisionError), compiling.compile_beside("demo"):
        raise ZeroDivisionError
    assert started
    assert all(worker.poll() is not None for worker in started)
