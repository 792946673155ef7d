"""Damaged frames, requests and lines of sensors, for `fuzz`."""

from __future__ import annotations

import json
import struct
import time
from typing import Any

import cv2
import numpy as np
from tests.service.hostile_pictures import hostile

from rendezview.geometry.camera import Camera

CAMERA = Camera.from_fov(160, 120, np.deg2rad(40.0))
LIGHT = {"name": "a", "group": "g", "position_m": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0],
         "diameter_m": 0.02}  # fmt: skip
RING = {"centre_m": [0.0, 0.0, 0.0], "axis": [0.0, 0.0, 1.0], "radius_m": 0.5}
_POSE = {"quat_wxyz": [1.0, 0.0, 0.0, 0.0], "translation_m": [0.0, 0.0, 9.0]}
LINES: dict[str, dict[str, Any]] = {
    "mirrors": {"pose": _POSE, "covariance": (1e-4 * np.eye(6)).tolist(), "roll_ambiguous": False,
     "spots": [{"x_px": 10.0, "y_px": 20.0}]},
    "rim": {"ellipses": [{"centre_px": [80.0, 60.0], "semi_axes_px": [9.0, 8.0],
                           "angle_rad": 0.1}], "ellipse": 0,
             "poses": [{"centre_m": [0.0, 0.0, 9.0], "axis": [0.0, 0.0, -1.0],
                        "covariance": (1e-4 * np.eye(5)).tolist()}]},
    "laser": {"range_m": 9.0, "sigma_m": 0.02,
              "origin_m": [0.0, 0.0, 0.0], "direction": [0.0, 0.0, 1.0]},
}  # fmt: skip


class Cases:
    """Drawn from one generator, so that a seed repeats them."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        noise = self.rng.integers(0, 255, (120, 160), dtype=np.uint8)
        blob = noise // 16
        blob[30:90, 40:110] |= 128
        self.good = [
            blob.tobytes(),
            *(cv2.imencode(s, i)[1].tobytes() for s in (".png", ".jpg") for i in (blob, noise)),
            cv2.imencode(".png", np.zeros((120, 160, 3), np.uint8))[1].tobytes(),
            cv2.imencode(".png", np.zeros((120, 160), np.uint16))[1].tobytes(),
            cv2.imencode(".png", np.zeros((50, 60), np.uint8))[1].tobytes(),
        ]
        self.hostile = [make() for make in hostile(noise, 60_000).values()]

    def frame(self) -> bytes:
        """A frame that was good before something happened to it, or a hostile one."""
        rng = self.rng
        if rng.random() < 0.05:
            return self.hostile[rng.integers(len(self.hostile))]
        return self.damaged(self.good[rng.integers(len(self.good))])

    def damaged(self, good: bytes) -> bytes:
        """A file or a frame after something happened to it."""
        rng, content = self.rng, bytearray(good)
        for _ in range(rng.integers(1, 4)):
            how = rng.integers(7)
            if how == 0:
                content = content[: rng.integers(0, len(content) + 1)]
            elif how == 1 and content:
                for place in rng.integers(0, len(content), rng.integers(1, 30)):
                    content[place] = rng.integers(256)
            elif how == 2 and len(content) > 40:  # in the header
                content[rng.integers(0, 40)] = rng.integers(256)
            elif how == 3:
                place = rng.integers(0, len(content) + 1)
                content[place:place] = rng.bytes(rng.integers(1, 50))
            elif how == 4 and len(content) > 24:  # another size than it has
                size = struct.pack(">II", *rng.integers(0, 2**31, 2))
                content[16:24] = size
            elif how == 5:
                content = bytearray(rng.bytes(rng.integers(0, 3000)))
            else:
                other = self.good[rng.integers(len(self.good))]
                content[len(content) // 2 :] = other[len(other) // 2 :]
        return bytes(content)

    def value(self, depth: int = 0) -> object:
        """Some JSON."""
        rng = self.rng
        simple = [
            None, True, 0, -1, 1.5, 1e308, -1e308, 2**63, 10**30, "", "x" * 300, "\u0000", "..",
            "../../etc/passwd", "bumpy", [], {}, [1, 2, 3], [[]], "nan", "\ud7ff", 640, 480, 1e-320,
        ]  # fmt: skip
        if depth < 3 and rng.random() < 0.3:
            if rng.random() < 0.5:
                return [self.value(depth + 1) for _ in range(rng.integers(0, 5))]
            return {str(self.value(3))[:20]: self.value(depth + 1) for _ in range(3)}
        return simple[rng.integers(len(simple))]

    def request_of_session(self) -> bytes:
        """A request that is almost right."""
        rng = self.rng
        names = ("width", "height", "fx", "fy", "cx", "cy")
        request: dict[str, object] = {
            "camera": {name: getattr(CAMERA, name) for name in names} | {"distortion": []},
            "id": None,
            "prior": {"quat_wxyz": [1, 0, 0, 0], "translation_m": [0, 0, 9]},
            "sun_camera": [0, 0, -1],
            "fusion": {
                "ring": dict(RING),
                "surfaces": [],
                "options": {"history_s": 5.0},
                "reflectors": [dict(LIGHT) | {"name": str(k)} for k in range(3)],
            },
            "sensors": {"ring": True, "reflectors": "off", "trajectory": {"shape": "orbit"}},
        }
        place: dict[str, object] = request
        if rng.random() < 0.5:
            place = request[str(rng.choice(["camera", "prior", "fusion", "sensors"]))]  # type: ignore[assignment]
        place[str(rng.choice([*place, "more"]))] = self.value()
        text = json.dumps(request, allow_nan=True).encode()
        if rng.random() < 0.2:
            text = text[: rng.integers(len(text))] + rng.bytes(rng.integers(0, 4))
        return text

    def lines(self) -> tuple[str, bytes]:
        """A sensor, and lines of it that are almost right, at times that rise or do not."""
        rng = self.rng
        lines = []
        sensor = str(rng.choice(list(LINES)))
        for _ in range(rng.integers(1, 4)):
            line = json.loads(json.dumps(LINES[sensor]))
            line["time_s"] = time.time() + rng.normal()
            for _ in range(rng.choice([0, 0, 1, 2])):
                place = line
                while True:
                    keys = list(place) if isinstance(place, dict) else list(range(len(place)))
                    if not keys:
                        break
                    key = keys[rng.integers(len(keys))]
                    if isinstance(place[key], dict | list) and rng.random() < 0.7:
                        place = place[key]
                        continue
                    place[key] = self.value()
                    break
            lines.append(json.dumps(line, allow_nan=True).encode())
        text = bytearray(b"\n".join(lines))
        if rng.random() < 0.2:
            for at in rng.integers(0, len(text), rng.integers(1, 5)):
                text[at] = rng.integers(256)
        if rng.random() < 0.1:
            text = text[: rng.integers(len(text))]
        if rng.random() < 0.1:
            sensor = str(rng.choice(["ring", "laser", "camera", "x", "a b"]))
        return sensor, bytes(text)
