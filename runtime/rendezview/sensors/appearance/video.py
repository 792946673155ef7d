"""A run of the tracker as a video."""

from __future__ import annotations

from pathlib import Path

from rendezview.io.sequences import Frame, Sequence
from rendezview.io.sequences.frame import GreyImage
from rendezview.io.video_file import VideoWriter, playing_rate_hz
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation
from rendezview.sensors.appearance.overlay import Picture, draw_observation


def drawn(
    frame: Frame, image: GreyImage | None, observation: AppearanceObservation, model: ViewModel
) -> Picture:
    """One frame with its result, (H, W, 3) blue, green, red; an image of None was unreadable."""
    title = f"frame {frame.im_id}"
    if frame.time_s is not None:
        title += f"   {frame.time_s:.1f} s"
    return draw_observation(image, observation, frame.camera, model, title=title)


class TrackVideo(VideoWriter):
    """Draws every frame of a run."""

    def __init__(self, path: Path, rate_hz: float, model: ViewModel) -> None:
        super().__init__(path, rate_hz)
        self._model = model

    def watch(
        self, frame: Frame, image: GreyImage | None, observation: AppearanceObservation
    ) -> None:
        """Draw one frame with its result."""
        self.add(drawn(frame, image, observation, self._model))


def video_of(path: Path, sequence: Sequence, model: ViewModel) -> TrackVideo:
    """A video of a run over a sequence, at its own rate if that can be watched.

    Raises:
        RendezviewError: the name has an unknown ending, or its folder does not exist.
    """
    rate_hz = playing_rate_hz([frame.time_s for frame in sequence])
    return TrackVideo(path, rate_hz, model)
