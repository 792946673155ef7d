"""How a craft differs from its CAD model: a strain, parts mounted aside; and its camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.calibration.as_built.parts import MARGIN_RADII, Part, remounted
from rendezview.calibration.as_built.strain import matrix_of, strain_names, strained
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.measured import STRAINS, MeasuredEdges
from rendezview.sensors.appearance.model.view_model import ViewModel

_STRAINS = len(STRAINS)
_MOTION = 6  # of a part: rotation vector and shift. Source: by construction
_CAMERA = 3  # logarithm of the focal length's factor, shift of the principal point. Source: same


@dataclass(frozen=True, slots=True, eq=False)
class Deformation:
    """A strain about the view centre, the mounting of some parts, and what is wrong of the camera.

    A focal length that is wrong and a depth that is wrong differ as a wide-angle view differs from
    a long-lens view: near and far edges of the target tell.
    """

    strain: Array  # (6,) components, target axes
    parts: tuple[Part, ...] = ()
    lens: Array | None = None  # (3,) log of the focal length's factor, shift px; None: not asked

    @property
    def size(self) -> int:
        """Unknowns: strain; of each part its turn (rad) and shift (m); the camera's."""
        return int(self.of_lens.stop)

    def of_part(self, k: int) -> slice:
        """Where the unknowns of a part are."""
        return slice(_STRAINS + _MOTION * k, _STRAINS + _MOTION * (k + 1))

    @property
    def of_lens(self) -> slice:
        """Where the unknowns of the camera are."""
        first = _STRAINS + _MOTION * len(self.parts)
        return slice(first, first + (0 if self.lens is None else _CAMERA))

    def camera(self, camera: Camera) -> Camera:
        """The camera as it is."""
        if self.lens is None:
            return camera
        factor, (x_px, y_px) = float(np.exp(self.lens[0])), self.lens[1:]
        return replace(
            camera, fx=factor * camera.fx, fy=factor * camera.fy,
            cx=camera.cx + x_px, cy=camera.cy + y_px,
        )  # fmt: skip

    def after(self, step: Array) -> Deformation:
        """Changed by a step (size,)."""
        parts = tuple(part.after(step[self.of_part(k)]) for k, part in enumerate(self.parts))
        lens = None if self.lens is None else self.lens + step[self.of_lens]
        return Deformation(self.strain + step[:_STRAINS], parts, lens)

    def change(self, step: Array, radius_m: float, focal_px: float) -> float:
        """The largest change of a step; shifts as shares of target radius and focal length."""
        return float(np.abs(step / self._units(radius_m, focal_px)).max())

    def model(
        self, original: ViewModel, shape_error: float = 0.0, covariance: Array | None = None
    ) -> ViewModel:
        """The model so deformed; see ``strained``."""
        strain = matrix_of(self.strain)
        made = strained(original, strain, covariance, shape_error)
        if not self.parts:
            return made
        mounted = {part.name: part.motion.tolist() for part in self.parts}
        made = replace(made, provenance=made.provenance | {"mounted": mounted})
        return remounted(made, original, self.parts, strain)

    def members(self, edges: MeasuredEdges, radius_m: float) -> npt.NDArray[np.intp]:
        """(N,) which part each edge, measured with the model so deformed, is of; −1: of none."""
        found = np.full(len(edges.weight), -1, dtype=np.intp)
        unstretch = np.linalg.inv(self._stretch)
        for k, part in enumerate(self.parts):
            middle = self._stretch @ part.middle_m
            unmoved = (edges.places_m - middle - part.move_m) @ part.turn + middle
            inside = part.holds(unmoved @ unstretch.T, MARGIN_RADII * radius_m)
            found[inside & (found < 0)] = k
        return found

    def slopes(self, edges: MeasuredEdges, radius_m: float, camera: Camera) -> Array:
        """(N, size) of the predicted edges: px per unit of strain, px/rad, px/m, camera's.

        The lens's distortion is left out of the camera's slopes.
        """
        slopes = np.zeros((len(edges.weight), self.size))
        slopes[:, :_STRAINS] = edges.strain_slopes
        if self.lens is not None:
            in_camera = edges.places_m @ edges.rotation.T + edges.centre_m
            depth, shift = in_camera[:, 2:], edges.pose_slopes[:, 3:]
            across = shift[:, :2] * depth / (camera.fx, camera.fy)
            slopes[:, self.of_lens] = np.column_stack([-shift[:, 2:] * depth, across])
        if not self.parts:
            return slopes
        of = self.members(edges, radius_m)
        shift = edges.pose_slopes[:, 3:] @ edges.rotation
        for k, part in enumerate(
            self.parts
        ):  # about the middle of the part as it is mounted by now
            own = of == k
            arm = edges.places_m[own] - self._stretch @ part.middle_m - part.move_m
            slopes[own, self.of_part(k)] = np.hstack([np.cross(arm, shift[own]), shift[own]])
        return slopes

    def described(self) -> str:
        """In words."""
        strain = zip(strain_names(), self.strain, strict=True)
        words = [f"{name} {100 * value:+.2f} %" for name, value in strain]
        for part in self.parts:
            turn_deg = np.rad2deg(np.linalg.norm(part.motion[:3]))
            words.append(f"{part.name} {turn_deg:.2f}° {1e3 * np.linalg.norm(part.move_m):.1f} mm")
        if self.lens is not None:
            words.append(f"focal length {100 * np.expm1(self.lens[0]):+.2f} %")
        return ", ".join(words)

    @property
    def _stretch(self) -> Array:
        return np.asarray(np.eye(3) + matrix_of(self.strain))

    def _units(self, radius_m: float, focal_px: float) -> Array:
        units = np.ones(self.size)
        for k in range(len(self.parts)):
            units[self.of_part(k)][3:] = radius_m
        if self.lens is not None:
            units[self.of_lens][1:] = focal_px
        return units
