"""The command line of the experiments: ``python -m experiments NAME ARGUMENTS``."""

from __future__ import annotations

import importlib
import sys

# Group: name of the experiment: (module, summary).
EXPERIMENTS = {
    "recognition and pose": {
        "recognition-accuracy": ("recognition.accuracy", "active nodes and views, held-out frames"),
        "paper-trees": ("recognition.paper", "the paper's Table I, figures 3 and 4, its trees"),
        "tree-ablation": ("recognition.ablation", "learned, silenced and random trees"),
        "tree-witness": ("recognition.witness", "votes beside the confidence of the edges"),
        "recognition-speed": ("recognition.speed", "time from a frame to the active nodes"),
        "pose-frames": ("pose.frames", "draws the frames for pose-accuracy with Mitsuba"),
        "pose-accuracy": ("pose.accuracy", "first poses and tracked poses on these frames"),
        "pose-cut": ("pose.accuracy:cut", "poses of targets that the image border cuts"),
        "pose-scale": ("pose.scale", "poses over fields of view and picture sizes"),
        "close-in": ("pose.close_in", "poses close to a docking ring, from a prior"),
        "pose-times": ("pose.scale:times", "worst time of any picture under any option"),
        "pose-trials": ("pose.trials", "sequences, frames without a target, an inexact model"),
        "pose-mounting": ("pose.mounting", "a bent wing and a wrong camera file, calibrated"),
        "pose-shape": ("pose.shape", "a wrong mesh before and after calibration of its shape"),
        "pose-misfit": (
            "pose.shape:misfit",
            "covariances where the mesh is wrong and none says so",
        ),
        "pose-joints": ("pose.joints", "first poses and tracking of a target whose parts turn"),
        "pose-confidence": ("pose.confidence", "fits confidence and covariance to logs"),
        "photo-accuracy": ("pose.photo_accuracy", "poses from photographs in SPEED+'s form"),
        "sketch-confidence": ("pose.sketch_confidence", "fits the choice among poses of sketches"),
        "sketch-gain": ("pose.sketch_gain", "first poses with and without sketches, own frames"),
        "sketch-picture": ("pose.sketch_picture", "frames in hard light, their sketches, poses"),
        "pose-speed": ("pose.speed", "time of a pose beside its floors and peers"),
        "visp-tracking": ("pose.visp_tracking", "tracking beside ViSP's model-based tracker"),
    },
    "ring": {
        "ring-accuracy": ("ring.accuracy", "accuracy and detection beside OpenCV's detectors"),
        "ring-flyaround": ("ring.flyaround", "a ring of unknown size from a fly-around"),
        "ring-vehicle": ("ring.vehicle", "the ring among a vehicle's other circles"),
        "ring-size-pictures": ("ring.size_pictures", "a ring of unknown size, drawn fly-around"),
        "ring-speed": ("ring.speed", "time of a detection beside OpenCV's detectors"),
    },
    "reflectors": {
        "reflector-accuracy": ("reflectors.accuracy", "pose errors against the Cramér–Rao bound"),
        "reflector-acquisition": ("reflectors.acquisition", "acquisition among glints and foil"),
        "reflector-hidden": ("reflectors.hidden", "every three to five of five reflectors"),
        "reflector-hidden-runs": ("reflectors.hidden:tracked", "the same, tracked"),
        "reflector-handover": ("reflectors.handover", "from the far to the near group, by roll"),
        "reflector-larger": ("reflectors.handover:larger", "one outer reflector larger"),
        "reflector-nees": ("reflectors.nees", "errors against covariances, by condition"),
        "reflector-rates": (
            "reflectors.rates",
            "rates beside a line of eight readings and the bound",
        ),
        "reflector-tolerance": ("reflectors.nees:tolerance", "dots of another diameter or blur"),
        "reflector-real-spots": ("reflectors.real_spots", "centroids in real pictures of stars"),
        "reflector-s-curve": (
            "reflectors.real_spots:s_curve",
            "centroids over the place in a pixel",
        ),
        "reflector-solvers": ("reflectors.solvers", "a million P3P problems, beside peers"),
        "reflector-speed": ("reflectors.speed", "time of a reading beside OpenCV's moments"),
        "reflector-webcam": ("reflectors.webcam", "the webcam tutorial with a simulated camera"),
        "reflector-run": ("reflectors.run", "writes a simulated run as files"),
    },
    "stereo": {
        "stereo-accuracy": ("stereo.accuracy", "pose errors in the simulated laboratory"),
        "stereo-calibration": ("stereo.calibration", "calibration with and without rail errors"),
        "stereo-laboratory": ("stereo.laboratory", "writes a simulated laboratory as files"),
        "stereo-board": ("stereo.board", "NEES of a pair calibrated from a dozen board pairs"),
        "stereo-multiplex": ("stereo.multiplex", "lights one after the other, turning target"),
        "stereo-speed": ("stereo.speed", "readings a second"),
    },
    "trajectory": {
        "trajectory-frames": ("trajectory.frames", "draws paths and recognises their frames"),
        "trajectory-accuracy": ("trajectory.accuracy", "errors of segments, predictions and spin"),
        "trajectory-methods": ("trajectory.methods", "ways to fit a segment beside scipy"),
        "trajectory-speed": ("trajectory.speed", "time of a fit beside scipy and nlopt"),
        "close-approach": ("trajectory.close_approach", "approach until the target overflows"),
        "closed-loop": ("trajectory.closed_loop", "frames, recognition, fit and correction"),
        "ccsds-orekit": ("trajectory.ccsds_orekit", "our CCSDS messages read by Orekit"),
    },
    "fusion": {
        "fusion-approach": ("fusion.approach", "recognizer, ring, ranger and filter, 60 m to 1 m"),
        "fusion-ring-size": ("fusion.ring_size", "the ring's radius and depth as states"),
        "fusion-faults": ("fusion.faults", "one sensor dead, biased or late"),
        "fusion-speed": ("fusion.speed", "time of a filter step"),
    },
    "service": {
        "service-speed": ("service.speed", "cost of the service over the bare tracker"),
        "service-page": ("service.page", "load time and update rate of the page"),
        "service-memory": ("service.memory", "memory over many frames"),
        "service-kill": ("service.kill", "poses lost when the recording service is killed"),
        "service-move": ("service.move", "time without poses when a worker is killed"),
        "service-cluster": (
            "service.cluster",
            "nodes and gateways of a cluster killed while it tracks",
        ),
        "service-cluster-rate": ("service.cluster_rate", "what a frame costs on a cluster"),
        "service-approach": ("service.approach", "60 m to 1 m over HTTP beside the commands"),
        "service-fuzz": ("service.fuzz", "malformed frames and messages"),
    },
    "flight code": {
        "export-c-check": ("flight_code.check", "exported C beside the runtime, same frames"),
        "flight-code-search": ("flight_code.search", "views that the C code finds, by prior"),
    },
    "tuned numbers": {
        "number-effects": ("number_effects", "figures with each number halved and doubled"),
    },
    "startup": {
        "compiled-loops": ("startup.loops", "lists the loops that commands compile"),
    },
    "training": {
        "training-speed": ("training.speed", "time and memory of training"),
        "scale-out": ("training.scale_out", "several workers: speed, bytes, kills, cost"),
        "foreground-network": ("training.foreground_network", "trains the foreground network"),
        "sketch-network": ("training.sketch_network", "trains the sketch network (PyTorch)"),
        "check-bare-install": ("training.bare_install", "a plain install tracks a scene"),
    },
    "pictures": {
        "readme-picture": ("pictures:readme", "four frames of a demo"),
        "fusion-picture": ("pictures:fusion", "errors of sensors and filter over the range"),
        "reflector-picture": ("pictures:reflectors", "spots, triplet, windows and pose"),
        "ring-picture": ("pictures:ring", "the ring as the sensor reads it"),
        "simulation-picture": ("pictures:simulation", "what photographs have, option by option"),
        "stereo-picture": ("pictures:stereo", "figure 8 of Welch et al. (1991)"),
    },
    "integrity": {
        "integrity-draw": ("integrity.draw", "tracks sequences of every condition, in pieces"),
        "integrity-fit": ("integrity.fit", "fits tails, odds of a wrong pose and drift to them"),
        "integrity": ("integrity.judge", "misleading, alarmed, available; Stanford diagrams"),
        "evidence": ("evidence", "requirements, their tests and results, from a JUnit file"),
    },
    "golden file": {
        "golden": ("golden.command", "answers of all sensors, stored and compared, bit for bit"),
    },
    "benchmark": {
        "benchmark": ("benchmark.command", "everything beside its peers and floors"),
        "bop-toolkit-peer": ("peers.bop_toolkit", "our scores beside the BOP toolkit's"),
        "speed-score-peer": ("peers.speed_score", "our SPEED scores beside the published code"),
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
    module_name, _, function = entries[name].partition(":")
    module = importlib.import_module(f"experiments.{module_name}")
    from experiments.frame import run

    sys.exit(run(name, getattr(module, function or "run"), sys.argv[2:]))  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
