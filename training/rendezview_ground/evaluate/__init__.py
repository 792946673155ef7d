"""Comparison of estimates with truth: error measures, evaluation of sequences, reports."""

from rendezview.geometry.symmetry import discrete_turns, nearest_alike
from rendezview_ground.evaluate.comparison import comparison_dict, comparison_table
from rendezview_ground.evaluate.evaluate import evaluate
from rendezview_ground.evaluate.evaluation import (
    WRONG_RAD,
    Evaluation,
    FrameResult,
    Statistics,
    summary_rows,
)
from rendezview_ground.evaluate.pictures.frame_pictures import frame_overlay
from rendezview_ground.evaluate.pictures.palette import pixels, png
from rendezview_ground.evaluate.pictures.signature_pictures import (
    TreeTest,
    signature_picture,
    tree_tests,
)
from rendezview_ground.evaluate.pictures.sphere_pictures import model_picture, sphere_picture
from rendezview_ground.evaluate.pictures.track_pictures import (
    error_curves,
    observation_curves,
    point_cloud,
    stage_picture,
)
from rendezview_ground.evaluate.pose_errors import (
    SPEED_PLUS_ROTATION_RAD,
    SPEED_PLUS_TRANSLATION,
    PoseErrors,
    pose_errors,
    speed_terms,
)
from rendezview_ground.evaluate.report import write_report
from rendezview_ground.evaluate.scores import Scores, scores
from rendezview_ground.evaluate.surface import ModelPoints, SurfaceErrors, alike_of, surface_errors

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
