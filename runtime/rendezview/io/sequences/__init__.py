"""Image sequences: BOP scenes, folders of images, videos, SPEED and SPEED+, recordings."""

from rendezview.io.sequences.frame import Frame, Sequence
from rendezview.io.sequences.opening import open_sequence

__all__ = ["Frame", "Sequence", "open_sequence"]
