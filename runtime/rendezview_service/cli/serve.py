"""``rendezview serve``."""

from __future__ import annotations

import contextlib
import functools
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from rendezview.cli.compiling import compile_ahead, compile_beside
from rendezview.errors import RendezviewError, optional

if TYPE_CHECKING:
    from rendezview_service.settings import Settings


# Ray's settings for a gateway, read when it is imported.
_OF_RAY = {
    "USAGE_STATS_ENABLED": "0",  # it would report to its makers
    # A call to a slot that has ended fails at once: Ray otherwise waits for news of the cause, and
    # looks for it once a second. Source: measured, 0.2 to 0.3 s from a kill to the next answer
    "timeout_ms_task_wait_for_death_info": "10",
    "core_worker_internal_heartbeat_ms": "50",
    # Frames go along with their call, not by the object store: the first one to a node took seconds
    # there. Source: chosen, a raw frame of 2000 × 2000 px
    "max_direct_call_object_size": "4000000",
    "task_rpc_inlined_bytes_limit": "8000000",
}


# S, for a flight to end, then it is killed: less than the service takes. Source: by construction
_FLIGHT_END_S = 1.0
# Flags that are no settings, and those that have another name there.
_OWN = ("model", "source", "speed", "fly", "check", "settings")
_SETTINGS = {
    "foxglove": "foxglove_port", "rerun": "rerun_port", "ros": "ros_endpoint",
    "tokens": "tokens_file", "models": "models_folder", "state": "state_folder",
}  # fmt: skip


def serve(
    model: Annotated[
        Path | None, typer.Argument(help="Model file (*.rvm); more can be sent by the API.")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Camera file, of sessions that give none.")
    ] = None,
    target: Annotated[
        Path | None,
        typer.Option(
            help="Target file: its docking ring, found in the frames, and its reflectors."
        ),
    ] = None,
    approach: Annotated[
        Path | None, typer.Option(help="Docking port, corridor, keep-out zone and limits (TOML).")
    ] = None,
    plan: Annotated[
        Path | None, typer.Option(help="Planned path (TOML), as for `rendezview track`.")
    ] = None,
    source: Annotated[
        list[str] | None,
        typer.Option(
            help="Source for the service: scene, folder, video, log (*.mcap), /dev/video0, "
            "rtsp://…; repeat it for more sessions."
        ),
    ] = None,
    fly: Annotated[
        str | None,
        typer.Option(help="Fly to this target, as `rendezview fly --live`; RENDEZVIEW_TOKEN."),
    ] = None,
    speed: Annotated[
        float, typer.Option(min=0.0, help="Of sources that are files; 0: as fast as they track.")
    ] = 1.0,
    record: Annotated[
        Path | None, typer.Option(help="Log (*.mcap) of the first session, or a folder for logs.")
    ] = None,
    record_images: Annotated[
        bool | None, typer.Option("--record-images/--no-record-images", help="In the logs.")
    ] = None,
    sync: Annotated[
        str | None, typer.Option(help="fsync of logs: always, interval (a second), never.")
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on. [127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="Port; 0 for any that is free. [8360]")] = None,
    foxglove: Annotated[
        int | None, typer.Option(help="Port of a live stream for Foxglove; no tokens.")
    ] = None,
    rerun: Annotated[
        int | None, typer.Option(help="Port of a live stream for Rerun; no tokens.")
    ] = None,
    ros: Annotated[
        str | None,
        typer.Option(help="Zenoh router that takes poses for ROS 2, such as tcp/127.0.0.1:7447."),
    ] = None,
    tokens: Annotated[
        Path | None, typer.Option(help="Tokens (TOML): who may read, track, admin.")
    ] = None,
    open_to_all: Annotated[
        bool | None, typer.Option("--open-to-all", help="Let others in without tokens.")
    ] = None,
    tls_certificate: Annotated[Path | None, typer.Option(help="PEM file.")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="PEM file.")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes that track. [one a core]")] = None,
    models: Annotated[
        Path | None, typer.Option(help="Folder of the models that are sent or trained.")
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(help="Address of a Ray cluster that tracks: be one of its gateways."),
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(help="Folder of open sessions, which go on after a restart; see the docs."),
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Check files, folders, clock, ports and models; do not serve."
        ),
    ] = False,
    settings: Annotated[
        Path | None, typer.Option(help="Any of these and more, in a TOML file; see the docs.")
    ] = None,
) -> None:
    """Serve poses: frames in by HTTP or WebSocket, poses out, a page to watch them at /.

    \b
    Example: rendezview serve hubble.rvm --camera camera.yaml --record run.mcap
    """
    given = locals()
    with optional("`rendezview serve` needs", "service", ", which is not installed"):
        from rendezview_service.hub.service import Service
        from rendezview_service.json_logging import set_up_logging
        from rendezview_service.server import run
        from rendezview_service.settings import load_settings
        from rendezview_service.worker.worker_models import LOOPS, SENSOR_LOOPS
    flags = {_SETTINGS.get(flag, flag): value for flag, value in given.items() if flag not in _OWN}
    loaded = load_settings(settings, flags)
    if check:
        from rendezview_service.cli.check import check as is_well

        raise typer.Exit(0 if is_well(loaded, model) else 1)
    console = Console(stderr=True)

    def say(said: str, address: str) -> None:
        console.print(f"rendezview {said} {address}", highlight=False, soft_wrap=True)

    tell = functools.partial(say, "serves at")

    if loaded.cluster is not None:
        _be_gateway(loaded, bool(model or source), tell)
        return
    service = Service(loaded, model, source, speed)
    compile_ahead(*LOOPS)
    set_up_logging(loaded.log_level)
    with contextlib.ExitStack() as flights, compile_beside(*SENSOR_LOOPS) as beside:
        service.workers.without_sensors = lambda: beside.is_busy

        def ready(address: str) -> None:
            tell(address)
            if fly is not None:
                flights.enter_context(_flight(fly, address))

        run(service, ready, functools.partial(say, "starts; its page is at"))


@contextlib.contextmanager
def _flight(target: str, address: str) -> Iterator[None]:
    """A flight at the service, in a process that ends with it."""
    from rendezview_service.hub.child_program import end

    command = [sys.executable, "-m", "rendezview", "fly", target, "--live", address]
    with subprocess.Popen(command) as process:
        try:
            yield
        finally:
            end(process, _FLIGHT_END_S)


def _be_gateway(settings: Settings, has_own: bool, tell: Callable[[str], None]) -> None:
    from rendezview_service.json_logging import set_up_logging
    from rendezview_service.server import run_gateway

    if has_own or None in (settings.models_folder, settings.state_folder):
        raise RendezviewError(
            "a gateway has no model or source of its own: give --models and --state, "
            "folders that all nodes share"
        )
    for name, value in _OF_RAY.items():
        os.environ.setdefault(f"RAY_{name}", value)
    with optional("--cluster needs", "ray"):
        import ray  # noqa: F401
    set_up_logging(settings.log_level)
    paths = {name: value.resolve() for name, value in settings if isinstance(value, Path)}
    run_gateway(settings.model_copy(update=paths), tell)
