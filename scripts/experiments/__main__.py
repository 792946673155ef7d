"""The command line of the experiments: ``python -m experiments NAME ARGUMENTS``."""

from __future__ import annotations

import importlib
import sys

# Group: name of the experiment: (module, what it makes).
EXPERIMENTS = {
    "recognition and pose": {
        "recognition-accuracy": ("recognition.accuracy", "active nodes and views, held-out frames"),
        "pose-frames": ("pose.frames", "draws the frames for pose-accuracy with Mitsuba"),
        "pose-accuracy": ("pose.accuracy", "first poses and tracked poses on these frames"),
        "pose-confidence": ("pose.confidence", "whether it holds on random craft"),
        "confidence-fit": ("pose.confidence_fit", "fits the confidence of poses by grey edges"),
        "photo-accuracy": ("pose.photo_accuracy", "poses from photographs in SPEED+'s form"),
        "sketch-confidence": ("pose.sketch_confidence", "fits the choice among poses of sketches"),
    },
    "ring, reflectors, stereo": {
        "ring-accuracy": ("ring.accuracy", "accuracy and detection beside OpenCV's detectors"),
        "ring-size": ("ring.size", "size of a ring from drawn fly-arounds"),
        "reflector-accuracy": ("reflectors.accuracy", "pose errors against the Cramér–Rao bound"),
        "reflector-hidden": ("reflectors.hidden", "every three to five of five reflectors"),
        "reflector-nees": ("reflectors.nees", "errors against covariances, by condition"),
        "reflector-pattern": ("reflectors.pattern", "places of reflectors from a run"),
        "stereo-accuracy": ("stereo.accuracy", "pose errors in the simulated laboratory"),
    },
    "trajectory and fusion": {
        "trajectory-accuracy": ("trajectory.accuracy", "errors of segments, predictions and spin"),
        "fusion-approach": ("fusion.approach", "recognizer, ring, ranger and filter, 60 m to 1 m"),
        "fusion-faults": ("fusion.faults", "one sensor dead, biased or late"),
    },
    "service": {
        "service-speed": ("service.speed", "cost of the service over the bare tracker"),
        "service-faults": ("service.faults", "kills, sick disks, malformed and hostile requests"),
    },
    "flight code and startup": {
        "export-c-check": ("flight_code.check", "exported C beside the runtime, same frames"),
        "compiled-loops": ("startup.loops", "lists the loops that commands compile"),
    },
    "training": {
        "sketch-network": ("training.sketch_network", "trains the sketch network (PyTorch)"),
    },
    "integrity": {
        "integrity-draw": ("integrity.draw", "tracks sequences of every condition, in pieces"),
        "integrity-fit": ("integrity.fit", "fits tails, odds of a wrong pose and drift to them"),
        "integrity": ("integrity.judge", "misleading, alarmed, available; Stanford diagrams"),
    },
    "benchmark and pictures": {
        "golden": ("golden.command", "answers of all sensors, stored and compared, bit for bit"),
        "benchmark": ("benchmark.command", "everything beside its peers and floors"),
        "pictures": ("pictures", "the drawings of the README and the docs"),
    },
}


def listing() -> str:
    """All experiments in their groups, a line each."""
    lines = ["python -m experiments NAME [ARGUMENTS]; NAME --help explains it"]
    for group, experiments in EXPERIMENTS.items():
        lines += ["", group]
        lines += [f"  {name:24}{what}" for name, (_, what) in experiments.items()]
    return "\n".join(lines)


def main() -> None:
    """Run one experiment; without arguments list them."""
    if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
        print(listing())
        return
    name = sys.argv[1]
    entries = {n: entry for group in EXPERIMENTS.values() for n, (entry, _) in group.items()}
    if name not in entries:
        sys.exit(f"no experiment {name!r}; python -m experiments lists them")
    module = importlib.import_module(f"experiments.{entries[name]}")
    from experiments.frame import run

    sys.exit(run(name, module.run, sys.argv[2:]))  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
