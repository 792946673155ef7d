"""A viewer of the Foxglove stream, which subscribes to all that it offers."""

from __future__ import annotations

import contextlib
import itertools
import json
import struct

from websockets.sync.client import ClientConnection


class FoxgloveViewer:
    """Keeps the last message of each topic in ``seen``."""

    def __init__(self, socket: ClientConnection) -> None:
        self.seen: dict[str, bytes] = {}
        self.channels: dict[str, int] = {}
        self._socket, self._numbers = socket, itertools.count()
        self._subscribed: dict[int, str] = {}

    def listen(self, within_s: float) -> None:
        """Take what comes, until nothing has come for a time.

        Topics of which nothing has come are subscribed to again: the package advertises a channel a
        moment before it takes subscriptions, and answers an early one with "Unknown channel ID".
        """
        for topic in self.channels.keys() - self.seen.keys():
            self._subscribed[number := next(self._numbers)] = topic
            asked = [{"id": number, "channelId": self.channels[topic]}]
            self._socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        with contextlib.suppress(TimeoutError):
            while True:
                message = self._socket.recv(within_s)
                if isinstance(message, str):
                    told = json.loads(message)
                    new = told.get("channels", []) if told["op"] == "advertise" else []
                    self.channels.update({channel["topic"]: channel["id"] for channel in new})
                elif message[0] == 1:  # message data: subscription, time, content
                    (number,) = struct.unpack("<I", message[1:5])
                    self.seen[self._subscribed[number]] = message[13:]
