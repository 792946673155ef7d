"""Settings of the service: from a file, the environment and flags, in rising precedence."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from rendezview.errors import RendezviewError
from rendezview.io.files import describe, read_toml

LOOPBACK = ("127.0.0.1", "::1", "localhost")


class Settings(BaseSettings):
    """All settings; environment variables are ``RENDEZVIEW_SERVE_<NAME>``."""

    # Workers get them as JSON, infinities too: `idle_s = inf` closes no session.
    model_config = SettingsConfigDict(
        env_prefix="RENDEZVIEW_SERVE_", extra="forbid", ser_json_inf_nan="constants"
    )

    host: str = "127.0.0.1"
    port: int = Field(default=8360, ge=0, le=65535)  # 0: any free one
    allowed_hosts: list[str] = []  # other host names of the service
    tls_certificate: Path | None = None  # PEM
    tls_key: Path | None = None
    tokens_file: Path | None = None  # TOML, see `security.read_tokens`
    open_to_all: bool = False  # serve other machines without tokens

    models_folder: Path | None = None  # uploaded and trained models; default: a temporary folder
    # Open sessions go on from there after a restart; all nodes of a cluster share it.
    state_folder: Path | None = None
    camera: Path | None = None  # for sessions that give none
    target: Path | None = None  # its ring and reflectors, for sessions without
    approach: Path | None = None  # docking port, corridor, limits, for sessions that give none
    plan: Path | None = None  # the planned path, as `rendezview track --plan`
    record: Path | None = None  # *.mcap for the first session, or a folder
    record_all: bool = True  # record sessions that do not choose, if `record` is given
    record_images: bool = True
    record_model: bool = True  # with images: the log can be replayed on its own
    sync: Literal["always", "interval", "never"] = "interval"  # fsync; `interval`: each second
    compression: Literal["", "lz4", "zstd"] = "lz4"
    log_part_bytes: int = Field(default=1_000_000_000, ge=1_000_000)  # then the next part begins
    log_part_s: float = Field(default=3600.0, ge=1.0)  # the same
    log_wait_s: float = Field(default=0.25, ge=0.0)  # an answer waits so long for the disk
    log_memory_bytes: int = Field(default=64_000_000, ge=0)  # of what waits longer, of a session
    logs_bytes: int = Field(default=0, ge=0)  # of all logs; the oldest are removed; 0: keep all
    logs_s: float = Field(default=0.0, ge=0.0)  # logs that are older are removed; 0: keep all

    foxglove_port: int | None = Field(default=None, ge=0, le=65535)  # live stream; none by default
    rerun_port: int | None = Field(default=None, ge=1, le=65535)  # the same
    ros_endpoint: str | None = None  # of a Zenoh router that takes poses for ROS 2
    viewer_host: str = "127.0.0.1"  # where these streams listen; they have no tokens

    cluster: str | None = None  # address of a Ray cluster that tracks; this is then a gateway
    spare_seats: int = Field(default=1, ge=0)  # of the cluster, kept free for sessions that move

    workers: int = Field(default=0, ge=0, le=256)  # worker processes; 0: one per core
    spare_worker: bool = True  # one more process, ready to take over
    sessions: int = Field(default=16, ge=1, le=1024)
    watchers: int = Field(default=32, ge=1)  # of all sessions
    waiting: int = Field(default=4, ge=1, le=256)  # frames of plain requests, of a session
    frame_bytes: int = Field(default=32_000_000, ge=1024, le=1_000_000_000)
    model_bytes: int = Field(default=200_000_000, ge=1024)
    mesh_bytes: int = Field(default=200_000_000, ge=1024)
    sensors: int = Field(default=8, ge=0, le=64)  # of a session, beside its camera; 0: none
    measurement_bytes: int = Field(default=256_000, ge=256)  # of a message of a sensor
    measurement_lines: int = Field(default=32, ge=1, le=1000)  # in one message
    measurements_waiting: int = Field(default=16, ge=1, le=256)  # messages, of a session
    measurements_per_s: float = Field(default=500.0, gt=0.0)  # lines, of a session
    bodies_bytes: int = Field(default=64_000_000, ge=1024)  # in memory, of all who send
    uploads_bytes: int = Field(default=200_000_000, ge=1024)  # of models and meshes, on disk
    connections: int = Field(default=1000, ge=10)  # half for requests, a quarter for WebSockets
    message_bytes: int = Field(default=1_000_000, ge=1024)  # any other body
    requests_per_s: float = Field(default=5000.0, gt=0.0)  # of one caller
    frame_timeout_s: float = Field(default=5.0, gt=0.0)  # then the worker is restarted
    sender_hold_s: float = Field(default=2.0, ge=0.0)  # a silent sender keeps its session
    idle_s: float = Field(default=60.0, gt=0.0)  # sessions without frames for longer are closed
    history_s: float = Field(default=300.0, ge=0.0)
    history_bytes: int = Field(default=100_000_000, ge=1024)  # of all sessions together
    history_rate_hz: float = Field(default=30.0, gt=0.0)
    history_image_hz: float = Field(default=4.0, ge=0.0)
    history_image_px: int = Field(default=480, ge=16, le=4096)
    jobs: int = Field(default=1, ge=0, le=64)  # training jobs at once; 0: none
    job_s: float = Field(default=21_600.0, gt=0.0)  # of one training
    job_bytes: int = Field(default=16_000_000_000, ge=1_000_000_000)  # of each of its processes
    log_level: Literal["debug", "info", "warning", "error"] = "info"

    @property
    def record_folder(self) -> Path | None:
        """The folder of the logs; None: nothing is recorded."""
        if self.record is None or self.record.suffix != ".mcap":
            return self.record
        return self.record.parent


def load_settings(file: Path | None, flags: dict[str, Any]) -> Settings:
    """Settings of a TOML file, over them the environment, over them the flags that were given.

    Raises:
        RendezviewError: the file is missing or wrong, or a setting impossible.
    """
    content: dict[str, Any] = {}
    if file is not None:
        content = read_toml(file, "settings of the service")
        unknown = sorted(set(content) - set(Settings.model_fields))
        if unknown:
            raise RendezviewError(
                f"{file}: {unknown[0]}: unknown key, remove it or correct its spelling"
            )
    given = {name: value for name, value in flags.items() if value is not None}
    try:
        environment = Settings().model_dump(exclude_unset=True)
        settings = Settings(**(content | environment | given))
    except ValidationError as error:
        raise RendezviewError(f"settings of the service: {describe(error)}") from None
    except ValueError as error:  # an environment variable that is no JSON
        raise RendezviewError(f"settings of the service: {error}") from None
    if (settings.tls_certificate is None) != (settings.tls_key is None):
        raise RendezviewError("TLS needs both a certificate and a key: give --tls-key too")
    only_here = settings.host in LOOPBACK or settings.host.startswith("127.")
    if not only_here and settings.tokens_file is None and not settings.open_to_all:
        raise RendezviewError(
            f"{settings.host} is open to other machines: give --tokens FILE, or "
            "--open-to-all if the network is trusted"
        )
    return settings
