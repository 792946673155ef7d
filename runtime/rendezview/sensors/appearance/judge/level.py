"""What aligns and judges poses in pictures of one size."""

from __future__ import annotations

from dataclasses import dataclass

from rendezview.geometry.camera import Camera
from rendezview.sensors.appearance.edges.refinement import RefineOptions, Refiner
from rendezview.sensors.appearance.judge.rivals import Rivals
from rendezview.sensors.appearance.judge.shading import Shading
from rendezview.sensors.appearance.model.view_model import ViewModel


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """Refiner and judges of one model, in the frames of one camera."""

    camera: Camera
    refiner: Refiner
    shading: Shading
    rivals: Rivals | None  # None: the model has no shape

    @classmethod
    def of(cls, model: ViewModel, camera: Camera) -> Level:
        """The level of the camera's own pictures."""
        shading = Shading(model, camera)
        rivals = None if model.shape is None else Rivals(model, camera, shading)
        return cls(camera, Refiner(model, camera), shading, rivals)

    def with_camera(self, camera: Camera, options: RefineOptions | None = None) -> Level:
        """The same in the frames of another camera; ``options`` of refinement: None for the own."""
        refiner = Refiner(self.refiner.model, camera, options or self.refiner.options)
        if refiner.articulation is not None and self.refiner.articulation is not None:
            refiner.articulation.start_rad = self.refiner.articulation.start_rad
            refiner.articulation.tracked = self.refiner.articulation.tracked
        rivals = None if self.rivals is None else self.rivals.with_camera(camera)
        return Level(camera, refiner, self.shading.with_camera(camera), rivals)
