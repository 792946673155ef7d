"""Recognition of views by their radial signatures (Cleghorn & Sternberg 1991)."""

from rendezview.appearance.match import Match, MatchOptions
from rendezview.appearance.model import ViewModel
from rendezview.appearance.recognizer import Recognizer, Sighting
from rendezview.appearance.silhouette import (
    Cleaning,
    Silhouette,
    SilhouetteOptions,
    Threshold,
)
from rendezview.appearance.status import Status
from rendezview.appearance.tracker import Tracker, TrackerOptions

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
