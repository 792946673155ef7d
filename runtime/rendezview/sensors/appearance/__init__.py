"""Recognition of views by their radial signatures (Cleghorn & Sternberg 1991)."""

from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation
from rendezview.sensors.appearance.outline.silhouette import (
    Cleaning,
    Silhouette,
    SilhouetteOptions,
    Threshold,
)
from rendezview.sensors.appearance.outline.votes import Match, MatchOptions
from rendezview.sensors.appearance.recognizer import Recognizer
from rendezview.sensors.appearance.tracker import Tracker, TrackerOptions

__all__ = [
    "AppearanceObservation",
    "Cleaning",
    "Match",
    "MatchOptions",
    "Recognizer",
    "Silhouette",
    "SilhouetteOptions",
    "Threshold",
    "Tracker",
    "TrackerOptions",
    "ViewModel",
]
