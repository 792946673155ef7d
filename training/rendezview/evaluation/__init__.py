"""Comparison of estimates with truth: error measures, evaluation of sequences, reports."""

from rendezview.evaluation.comparison import comparison_dict, comparison_table
from rendezview.evaluation.evaluate import evaluate
from rendezview.evaluation.evaluation import (
    WRONG_RAD,
    Evaluation,
    FrameResult,
    Statistics,
    summary_rows,
)
from rendezview.evaluation.frame_pictures import frame_overlay
from rendezview.evaluation.palette import pixels, png
from rendezview.evaluation.pose_errors import (
    SPEED_PLUS_ROTATION_RAD,
    SPEED_PLUS_TRANSLATION,
    PoseErrors,
    pose_errors,
    speed_terms,
)
from rendezview.evaluation.report import write_report
from rendezview.evaluation.scores import Scores, scores
from rendezview.evaluation.signature_pictures import TreeTest, signature_picture, tree_tests
from rendezview.evaluation.sphere_pictures import model_picture, sphere_picture
from rendezview.evaluation.surface import ModelPoints, SurfaceErrors, alike_of, surface_errors
from rendezview.evaluation.track_pictures import (
    error_curves,
    observation_curves,
    point_cloud,
    stage_picture,
)
from rendezview.geometry.symmetry import discrete_turns, nearest_alike

__all__ = [
    "SPEED_PLUS_ROTATION_RAD",
    "SPEED_PLUS_TRANSLATION",
    "WRONG_RAD",
    "Evaluation",
    "FrameResult",
    "ModelPoints",
    "PoseErrors",
    "Scores",
    "Statistics",
    "SurfaceErrors",
    "TreeTest",
    "alike_of",
    "comparison_dict",
    "comparison_table",
    "discrete_turns",
    "error_curves",
    "evaluate",
    "frame_overlay",
    "model_picture",
    "nearest_alike",
    "observation_curves",
    "pixels",
    "png",
    "point_cloud",
    "pose_errors",
    "scores",
    "signature_picture",
    "speed_terms",
    "sphere_picture",
    "stage_picture",
    "summary_rows",
    "surface_errors",
    "tree_tests",
    "write_report",
]
