"""Calibration of photodiode cameras in the laboratory, step by step as in the paper.

Detector response from a scan (eq. 5); principal point and point of symmetry from aligned
beams; lens from a plate of lights (eq. 6); places of the cameras by resection on plates at
surveyed places, checked by triangulation. Then, beyond the paper, all of it once more
together by bundle adjustment, where each step's result is an observation with its σ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rendezview.calibration.board import pose_of_points, rig_of
from rendezview.calibration.bundle import Adjusted, Bundle, Observations, adjust
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.detect.brown_lens import Lens
from rendezview.sensors.beacons.detect.detectors import Photodiode
from rendezview.sensors.beacons.detect.photodiode import Normalisation, ResponseFit, fit_response
from rendezview.sensors.beacons.rig import Rig, RigCamera, Sights

EVERYTHING = ("f", "cx", "cy", "l1", "l2", "l3", "p1", "p2", "p3", "ox", "oy")
_LENS = ("l1", "l2", "l3", "p1", "p2", "p3")


@dataclass(frozen=True, slots=True, eq=False)
class CameraRecord:
    """What was measured on one camera."""

    name: str
    focal_m: float  # nominal
    half_width_m: float
    beam_m: Array  # (N, 2) places of the scanned beam
    scan: Array  # (S, N, 4) currents there
    principal_beam: Array  # (K, 4) beam along the normal of the detector, lens off
    lens_beam: Array  # (K, 4) beam along the axis of the lens


@dataclass(frozen=True, slots=True, eq=False)
class PlateView:
    """The plate of lights at one place, averaged over frames."""

    rig_from_plate: Pose | None  # surveyed, or not known
    currents: tuple[Array | None, ...]  # of each camera, (P, 4); NaN where a light is not visible
    frames: int = 60


@dataclass(frozen=True, slots=True, eq=False)
class LaboratoryRecord:
    """Everything that the calibration of a photodiode rig starts from."""

    cameras: tuple[CameraRecord, ...]
    plate_m: Array  # (P, 3) lights of the plate, the paper's 6 × 7
    plate_sigma_m: float  # how well their places are known
    views: tuple[PlateView, ...]


@dataclass(frozen=True, slots=True)
class Step:
    """One step's residual, before and after, metres on the detector (or in space)."""

    name: str
    before_m: float
    after_m: float


@dataclass(frozen=True, slots=True, eq=False)
class LaboratoryCalibration:
    """The rig, and how each step went."""

    rig: Rig
    responses: tuple[ResponseFit, ...]
    together: Adjusted
    steps: tuple[Step, ...] = field(default=())


def aligned_beam(currents: Array, diode: Photodiode) -> tuple[Array, Array]:
    """Place of a beam on the detector (2,) and its σ (2,), from repeated readings (K, 4)."""
    places = diode.response.positions(currents)
    places = places[np.isfinite(places).all(axis=1)]
    if len(places) < 2:
        raise RendezviewError("an aligned beam needs at least two readings with light")
    return places.mean(axis=0), places.std(axis=0, ddof=1) / np.sqrt(len(places))


def calibrate_laboratory(
    record: LaboratoryRecord, normalisation: Normalisation = Normalisation.TOTAL, order: int = 5
) -> LaboratoryCalibration:
    """All steps, then all together.

    Args:
        record: what was measured.
        normalisation: of the currents (eq. 1, 2).
        order: of the detector's response; the paper's 3 leaves more than the noise.

    Raises:
        RendezviewError: something is missing or does not determine its parameters.
    """
    if not any(view.rig_from_plate is not None for view in record.views):
        raise RendezviewError("no view of the plate is at a surveyed place: add rig_from_plate")
    steps: list[Step] = []
    responses: list[ResponseFit] = []
    cameras: list[RigCamera] = []
    priors: list[tuple[int, str, float, float]] = []
    for k, one in enumerate(record.cameras):
        fit = fit_response(one.beam_m, one.scan, normalisation, order)
        steps.append(Step(f"{one.name}: response", fit.linear_rms_m, fit.rms_m))
        responses.append(fit)
        camera, beams = _with_beams(one, fit)
        priors += [(k, *beam) for beam in beams]
        camera, step = _with_lens(camera, k, record)
        steps.append(step)
        camera, step = _resected(camera, k, record)
        steps.append(step)
        cameras.append(camera)
    views = tuple(
        view.rig_from_plate or _unsurveyed(cameras, k, record)
        for k, view in enumerate(record.views)
    )
    observed = _observations(cameras, record, range(len(cameras)), range(len(views)))
    bundle = Bundle(
        tuple(cameras), views, record.plate_m, (EVERYTHING,) * len(cameras),
        (True,) * len(cameras), tuple(view.rig_from_plate is None for view in record.views),
        record.plate_sigma_m, tuple(priors), tuple(fit.covariance for fit in responses),
    )  # fmt: skip
    before = _apart(Rig(tuple(cameras)), record)
    together = adjust(bundle, observed)
    rig = _with_responses(rig_of(together), together)
    steps.append(Step("all: triangulated lights, in space", before, _apart(rig, record)))
    return LaboratoryCalibration(rig, tuple(responses), together, tuple(steps))


def _with_responses(rig: Rig, together: Adjusted) -> Rig:
    cameras = []
    for camera, offset in zip(rig.cameras, together.bundle.offsets, strict=True):
        assert camera.photodiode is not None
        response = camera.photodiode.response
        moved = replace(response, coefficients=response.coefficients + offset)
        cameras.append(replace(camera, photodiode=replace(camera.photodiode, response=moved)))
    return replace(rig, cameras=tuple(cameras))


def _with_beams(
    one: CameraRecord, fit: ResponseFit
) -> tuple[RigCamera, list[tuple[str, float, float]]]:
    if fit.electrode_sigma is None:
        raise RendezviewError(
            f"camera {one.name!r}: one scan does not determine the noise: give two"
        )
    diode = Photodiode(fit.response, fit.electrode_sigma, one.half_width_m)
    principal, sigma = aligned_beam(one.principal_beam, diode)
    centre, centre_sigma = aligned_beam(one.lens_beam, diode)
    off = (centre - principal) / one.focal_m
    off_sigma = np.hypot(centre_sigma, sigma) / one.focal_m
    # The misfit of the cubic is a floor under the σ of every place.
    expected = float(np.sqrt((diode.read(one.scan.mean(axis=0)).sigma ** 2).mean()))
    floor = np.sqrt(max(fit.rms_m**2 - expected**2 / len(one.scan), 0.0))
    camera = RigCamera(
        one.name, one.focal_m, one.focal_m, float(principal[0]), float(principal[1]),
        Pose.identity(), Lens(centre=(float(off[0]), float(off[1]))), photodiode=diode,
        floor=float(floor),
    )  # fmt: skip
    sigma, off_sigma = np.hypot(sigma, floor), np.hypot(off_sigma, floor / one.focal_m)
    beams = [(f"c{axis}", float(principal[i]), float(sigma[i])) for i, axis in enumerate("xy")]
    beams += [(f"o{axis}", float(off[i]), float(off_sigma[i])) for i, axis in enumerate("xy")]
    return camera, beams


def _with_lens(camera: RigCamera, k: int, record: LaboratoryRecord) -> tuple[RigCamera, Step]:
    """The lens from the views of the plate that only this camera sees (eq. 6)."""
    mine = [
        v for v, view in enumerate(record.views)
        if view.rig_from_plate is None and view.currents[k] is not None
    ]  # fmt: skip
    if not mine:
        raise RendezviewError(
            f"camera {camera.name!r}: no view without rig_from_plate, for its lens"
        )
    poses = tuple(_start(camera, record, k, v) for v in mine)
    observed = _observations([camera], record, [k], mine)
    plain = Bundle((camera,), poses, record.plate_m, ((),), (False,), (True,) * len(mine))
    before = adjust(plain, observed).rms
    fitted = adjust(replace(plain, free_intrinsics=(_LENS,)), observed)
    return fitted.bundle.cameras[0], Step(f"{camera.name}: lens", before, fitted.rms)


def _resected(camera: RigCamera, k: int, record: LaboratoryRecord) -> tuple[RigCamera, Step]:
    """Place of the camera, and its focal length, from the surveyed plates it sees."""
    mine = [
        v for v, view in enumerate(record.views)
        if view.rig_from_plate is not None and view.currents[k] is not None
    ]  # fmt: skip
    if not mine:
        raise RendezviewError(f"camera {camera.name!r} sees no plate at a surveyed place")
    surveyed = [record.views[v].rig_from_plate for v in mine]
    assert surveyed[0] is not None
    start = _start(camera, record, k, mine[0]) @ surveyed[0].inverse()
    placed = replace(camera, camera_from_rig=start)
    observed = _observations([camera], record, [k], mine)
    bundle = Bundle(
        (placed,), tuple(pose for pose in surveyed if pose is not None), record.plate_m, ((),),
        (True,), (False,) * len(mine),
    )  # fmt: skip
    before = adjust(bundle, observed).rms
    fitted = adjust(replace(bundle, free_intrinsics=(("f",),)), observed)
    return fitted.bundle.cameras[0], Step(f"{camera.name}: resection", before, fitted.rms)


def _start(camera: RigCamera, record: LaboratoryRecord, k: int, view: int) -> Pose:
    """camera_from_plate of one view, to start from."""
    currents = record.views[view].currents[k]
    assert currents is not None
    assert camera.photodiode is not None
    spots = camera.photodiode.read(currents)
    if len(spots) < 6:
        raise RendezviewError(
            f"view {view}: camera {camera.name!r} sees {len(spots)} lights of the plate, "
            "6 are needed"
        )
    ideal, _ = camera.ideal(spots)
    pose = pose_of_points(record.plate_m[spots.led], ideal, np.eye(3))
    if pose is None:
        raise RendezviewError(f"view {view} of the plate gives no pose in camera {camera.name!r}")
    return pose


def _unsurveyed(cameras: Sequence[RigCamera], view: int, record: LaboratoryRecord) -> Pose:
    for k, camera in enumerate(cameras):
        if record.views[view].currents[k] is not None:
            return camera.camera_from_rig.inverse() @ _start(camera, record, k, view)
    raise RendezviewError(f"view {view} of the plate is visible to no camera: leave it out")


def _observations(
    cameras: Sequence[RigCamera], record: LaboratoryRecord, which: Sequence[int],
    views: Sequence[int],
) -> Observations:  # fmt: skip
    parts = []
    for i, k in enumerate(which):
        diode = cameras[i].photodiode
        assert diode is not None
        for j, v in enumerate(views):
            currents = record.views[v].currents[k]
            if currents is None:
                continue
            averaged = replace(diode, noise=diode.noise / np.sqrt(record.views[v].frames))
            spots = averaged.read(currents)
            sigma = np.hypot(spots.sigma, cameras[i].floor)
            terms = diode.response.terms(currents[spots.led])
            parts.append((i, j, spots.led, spots.positions, sigma, terms))
    return Observations.joined(parts)


def _apart(rig: Rig, record: LaboratoryRecord) -> float:
    """R.m.s. distance of triangulated lights from the surveyed ones, metres."""
    away: list[Array] = []
    for view in record.views:
        if view.rig_from_plate is None:
            continue
        spots = [
            camera.photodiode.read(currents)
            for camera, currents in zip(rig.cameras, view.currents, strict=True)
            if camera.photodiode is not None and currents is not None
        ]
        if len(spots) == len(rig):
            points, ok = _intersect(rig, rig.sights(spots, len(record.plate_m)))
            away.append((points - view.rig_from_plate.apply(record.plate_m))[ok])
    if not away:
        return float("nan")
    return float(np.sqrt((np.concatenate(away) ** 2).sum(axis=1).mean()))


def _intersect(rig: Rig, sights: Sights) -> tuple[Array, np.ndarray]:
    """(L, 3) points of least squared distance from their rays, rig frame, and (L,) which exist.

    Photogrammetric triangulation (intersection), linear; a light needs two cameras.
    """
    visible = sights.visible
    rays = np.concatenate([sights.xy, np.ones((*visible.shape, 1))], axis=2) @ rig.rotations
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    origins = -np.einsum("kji,kj->ki", rig.rotations, rig.translations)
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    across *= visible[..., None, None]
    matrix = across.sum(axis=0)
    vector = np.einsum("kljm,km->lj", across, origins)
    usable = (visible.sum(axis=0) >= 2) & (np.linalg.det(matrix) > 1e-9)
    matrix[~usable] = np.eye(3)
    return np.linalg.solve(matrix, vector[..., None])[..., 0], usable
