"""``rendezview serve --check``, and the alert rules: what operators look at before and at night."""

from __future__ import annotations

import os
import re
import shutil
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import httpx
import numpy as np
import pytest
import yaml
from tests.waiting import MOST_S, wait_until

from rendezview.cli.main import main
from rendezview.errors import RendezviewError
from rendezview_service.cli import check

ROOT = Path(__file__).parents[2]
_METRIC = re.compile(r"\b(?:rendezview|process)_\w+")


@pytest.fixture
def look(monkeypatch, capsys, tmp_path) -> Callable[..., tuple[int, dict[str, str], list[str]]]:
    """Runs the command: its exit status, what it found by name, and the faults."""

    def run(*flags: object) -> tuple[int, dict[str, str], list[str]]:
        port = [] if "--port" in flags else ["--port", "0"]
        command = ["rendezview", "serve", "--check", *port, *map(str, flags)]
        monkeypatch.setattr(sys, "argv", command)
        with pytest.raises(SystemExit) as ended:
            main()
        lines = capsys.readouterr().out.splitlines()
        assert all(line.startswith(("OK     ", "FAULT  ")) for line in lines)
        found = dict(line[7:].split(": ", 1) for line in lines)
        return ended.value.code, found, [line[7:] for line in lines if line.startswith("FAULT")]

    return run


def test_what_is_well_is_said_and_nothing_is_made(look, model_path, tmp_path) -> None:
    stored, logs = tmp_path / "models", tmp_path / "logs"
    stored.mkdir()
    shutil.copy(model_path, stored / "stored.rvm")
    tokens = tmp_path / "tokens.toml"
    tokens.write_text('[one]\nscope = "read"\ntoken = "sixteen-letters-or-more"\n')
    flags = ("--models", stored, "--record", logs, "--tokens", tokens, "--foxglove", 0)
    code, found, faults = look(model_path, *flags)
    assert (code, faults) == (0, [])
    assert "will be made, writable" in found[f"record {logs}"]
    assert found[f"tokens {tokens}"] == "1 can be read"
    for path in (model_path, stored / "stored.rvm"):
        assert "162 nodes" in found[f"model {path}"]
    assert {"clock", "compiled loops", "port 127.0.0.1:0", "settings"} <= set(found)
    assert [*stored.iterdir()] == [stored / "stored.rvm"]
    assert not logs.exists()


def test_each_fault_has_a_line_with_its_remedy(look, monkeypatch, tmp_path) -> None:
    def fault(*flags: object) -> str:
        code, _, faults = look(*flags)
        assert code == 1
        assert len(faults) == 1
        return faults[0]

    models, file = tmp_path / "models", tmp_path / "file"
    models.mkdir()
    (models / "cut.rvm").write_bytes(b"junk")
    assert fault("--models", models).startswith(f"model {models / 'cut.rvm'}: ")
    file.touch()
    assert "give the user of the service" in fault("--record", file / "logs")
    assert "no such file" in fault("--camera", tmp_path / "none.yaml")
    assert "no such file" in fault("--tokens", tmp_path / "none.toml")
    assert "give a PEM file" in fault("--tls-certificate", file, "--tls-key", file)
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        monkeypatch.setattr(check, "_ANSWER_S", 0.1)  # it never answers
        assert "choose another --port" in fault("--port", port)
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / "later.mcap").touch()
    os.utime(logs / "later.mcap", (0.0, time.time() + 10 * 86_400))
    assert re.search(r"(9|10) days before .*later.mcap: set the clock", fault("--record", logs))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=5e8))
    assert "0.50 GB are free, of 1 GB at least" in fault("--record", tmp_path / "new")
    monkeypatch.undo()


def test_without_a_folder_for_compiled_loops_it_names_the_variable(monkeypatch) -> None:
    def refuses(**_: object) -> Callable[..., object]:
        raise RuntimeError("cannot cache function: no locator available for file")

    monkeypatch.setattr("numba.njit", refuses)
    with pytest.raises(RendezviewError, match="NUMBA_CACHE_DIR"):
        check._cache()


def test_a_service_that_runs_is_asked(look, service, client) -> None:
    port = service.url.rstrip("/").rpartition(":")[2]
    wait_until(lambda: client.request("GET", "/healthz")["status"] == "ok")
    code, found, _ = look("--port", port)
    assert code == 0
    count = len(client.sessions())
    assert found[f"port 127.0.0.1:{port}"] == f"a service answers, with {count} sessions"


def test_alert_rules_ask_for_metrics_that_exist(service, client, camera, tour) -> None:
    with client.open(camera, name="alerts", prior=tour[0][1]) as session:
        session.track(tour[0][2], 0.0)
        pose = tour[0][1].as_dict()
        told = {"time_s": 0.0, "pose": pose, "covariance": (1e-4 * np.eye(6)).tolist()}
        session.measure("mirrors", told)
        text = httpx.get(service.url + "metrics", timeout=MOST_S).text
    have = {line.split("{")[0].split(" ")[0] for line in text.splitlines() if line[:1] != "#"}
    (group,) = yaml.safe_load((ROOT / "deploy" / "alerts.yaml").read_text())["groups"]
    night = (ROOT / "docs" / "service-night.md").read_text()
    headings = set(re.findall(r"^## (.*)$", night, re.MULTILINE))
    names = [rule["alert"] for rule in group["rules"]]
    assert len(set(names)) == len(names) >= 15
    for rule in group["rules"]:
        asked = set(_METRIC.findall(rule["expr"]))
        assert asked or rule["expr"].startswith("up{"), rule["alert"]
        assert asked <= have, rule["alert"]
        assert rule["labels"]["severity"] in ("page", "warning")
        assert rule["annotations"]["summary"]
        assert rule["annotations"]["runbook"] in headings
    assert headings <= {rule["annotations"]["runbook"] for rule in group["rules"]}


def test_deployments_check_before_they_start_and_keep_a_state_folder() -> None:
    deploy = ROOT / "deploy"
    unit = (deploy / "rendezview.service").read_text()
    assert re.search(r"^ExecStartPre=-\S+ serve --check --settings (\S+)$", unit, re.MULTILINE)
    assert "/var/lib/rendezview/logs" in unit
    image = (deploy / "Containerfile").read_text()
    assert "serve --check" in image
    assert "VOLUME /var/lib/rendezview" in image
    volumes = yaml.safe_load((deploy / "compose.yaml").read_text())["services"]["rendezview"]
    assert "./state:/var/lib/rendezview" in volumes["volumes"]
