"""Recognition of views by their radial signatures (Cleghorn & Sternberg 1991)."""

from rendezview.sensors.appearance.model import ViewModel
from rendezview.sensors.appearance.outline.silhouette import (
    Cleaning,
    Silhouette,
    SilhouetteOptions,
    Threshold,
)
from rendezview.sensors.appearance.outline.votes import Match, MatchOptions
from rendezview.sensors.appearance.recognizer import Recognizer, Sighting
from rendezview.sensors.appearance.tracker import Tracker, TrackerOptions
from rendezview.sensors.observation import Status

__all__ = [
    "Cleaning",
    "Match",
    "MatchOptions",
    "Recognizer",
    "Sighting",
    "Silhouette",
    "SilhouetteOptions",
    "Status",
    "Threshold",
    "Tracker",
    "TrackerOptions",
    "ViewModel",
]
