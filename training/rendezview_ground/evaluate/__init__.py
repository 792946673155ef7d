"""Comparison of estimates with truth: error measures, evaluation of sequences, reports."""

from rendezview_ground.evaluate.evaluate import evaluate
from rendezview_ground.evaluate.pictures.frame_pictures import frame_overlay
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.evaluate.report import write_report

__all__ = ["evaluate", "frame_overlay", "png", "write_report"]
