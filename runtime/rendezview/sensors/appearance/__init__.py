"""Recognition of views by their radial signatures (Cleghorn & Sternberg 1991)."""

from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation
from rendezview.sensors.appearance.outline.silhouette import Cleaning, SilhouetteOptions, Threshold
from rendezview.sensors.appearance.outline.votes import MatchOptions
from rendezview.sensors.appearance.recognizer import Recognizer
from rendezview.sensors.appearance.tracker import Tracker, TrackerOptions

__all__ = [
    "AppearanceObservation",
    "Cleaning",
    "MatchOptions",
    "Recognizer",
    "SilhouetteOptions",
    "Threshold",
    "Tracker",
    "TrackerOptions",
    "ViewModel",
]
