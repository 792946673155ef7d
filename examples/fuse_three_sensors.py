"""Fuse: python examples/fuse_three_sensors.py model.rvm scene target.toml laser.jsonl"""

import sys

import rendezview as rv

frames, ring = rv.open_sequence(sys.argv[2]), rv.Target.load(sys.argv[3]).docking_ring
camera, plate = frames.frames[0].camera, rv.BeamSurface(ring.centre_m, ring.axis, relief_m=0.01)
tracker = rv.Tracker(rv.Recognizer(rv.ViewModel.load(sys.argv[1]), camera))
rings, fusion = rv.RingSensor(camera, ring.radius_m, circles=ring.circles), rv.Fusion()
laser = {line["time_s"]: line for line in rv.read_json_lines(sys.argv[4])}
for frame in frames:
    image, time_s, echo = frame.read(), frame.time_s, laser[frame.time_s]
    fusion.add(tracker.update(time_s, image).measurement("camera"))
    near = rv.RingPrior(range_m=echo["range_m"], range_sigma_m=0.01 * echo["range_m"])
    fusion.add(rings.update(time_s, image, near).measurement("ring", ring=ring))
    fusion.add(rv.RangeMeasurement(time_s, "laser", echo["range_m"], echo["sigma_m"], (plate,)))
    state = fusion.state_at(time_s)
    print(time_s, state.status, state.pose.translation_m if state.pose else state.reason)
for name, trust in fusion.trusts.items():
    print(name, trust.accepted, "measurements used")
