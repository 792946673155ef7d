"""The client of the pose service."""

from rendezview_service.client.connection import Client, SessionClient
from rendezview_service.client.messages import (
    Frame,
    ServiceError,
    ServiceTimeout,
    StateDict,
    fused_pose_of_state,
    pose_of_state,
)
from rendezview_service.client.stream import StreamClient

__all__ = [
    "Client",
    "Frame",
    "ServiceError",
    "ServiceTimeout",
    "SessionClient",
    "StateDict",
    "StreamClient",
    "fused_pose_of_state",
    "pose_of_state",
]
