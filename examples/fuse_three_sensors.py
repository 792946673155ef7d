"""Fuse: python examples/fuse_three_sensors.py model.rvm scene target.toml laser.jsonl"""

import sys

from rendezview.api import (
    BeamSurface,
    Fusion,
    RangeMeasurement,
    Recognizer,
    RingSensor,
    Target,
    Tracker,
    ViewModel,
    open_sequence,
    read_json_lines,
)  # fmt: skip

frames, ring = open_sequence(sys.argv[2]), Target.load(sys.argv[3]).docking_ring
camera, plate = frames.frames[0].camera, BeamSurface(ring.centre_m, ring.axis, relief_m=0.01)
tracker = Tracker(Recognizer(ViewModel.load(sys.argv[1]), camera))
rings, fusion = RingSensor(camera, ring.radius_m), Fusion()
laser = {line["time_s"]: line for line in read_json_lines(sys.argv[4])}
for frame in frames:
    image, time_s = frame.read(), frame.time_s
    fusion.add(tracker.update(time_s, image).measurement("camera"))
    fusion.add(rings.update(time_s, image).measurement("ring", ring=ring))
    echo = laser[time_s]
    fusion.add(RangeMeasurement(time_s, "laser", echo["range_m"], echo["sigma_m"], (plate,)))
    state = fusion.state_at(time_s)
    print(time_s, state.status, state.pose.translation_m if state.pose else state.reason)
for name, trust in fusion.trusts.items():
    print(name, trust.accepted, "measurements used")
