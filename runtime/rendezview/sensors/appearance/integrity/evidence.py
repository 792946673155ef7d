"""What speaks for a pose and against it: the input of its protection level."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.judge.sketch_choice import NEAR_RAD
from rendezview.sensors.appearance.observation import AppearanceObservation


@dataclass(frozen=True, slots=True, eq=False)
class Second:
    """The pose of a second estimator beside the first one's."""

    angle_rad: float  # between both attitudes
    confidence: float  # of the second


class Other(NamedTuple):
    """Another answer that was weighed with a pose."""

    angle_rad: float  # between both attitudes
    apart_m: float  # distance of both translations
    probability: float


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """One frame's evidence about its pose. NaN: not known."""

    time_s: float
    range_m: float  # of the view centre
    covariance: Array  # (6, 6) of the pose
    confidence: float
    prior: bool  # found near a prior …
    followed: bool  # … without a search
    sketched: bool  # found on a sketch
    outline: float  # inlier ratio of the outline
    inner: float  # inlier ratio of the inner edges
    visible: float  # share of the outline that lies in the picture
    residual_px: float
    light: float  # share of the grey levels that one light explains
    overshoot: float  # of bright outlines beyond the silhouette
    dark: bool  # the sky is
    shading: float  # agreement of bright and dark; NaN: not computed
    votes: float  # log odds of the forest; NaN: not asked
    trees: float  # weights of the active nodes about the pose
    margin: float  # merit above the rival's
    rival_rad: float  # angle to the rival; NaN: there is none
    rival_m: float  # distance of its translation from that of the pose
    innovation: Array | None = None  # (6,) from the prediction to the pose: rad, m
    others: tuple[Other, ...] = ()  # look-alikes that the frame leaves possible

    @classmethod
    def of(
        cls,
        observation: AppearanceObservation,
        time_s: float,
        predicted: Pose | None,
        centre_m: Array,
    ) -> Evidence | None:
        """The evidence in an observation; ``None`` without a refined pose.

        Args:
            observation: of the frame.
            time_s: of the frame.
            predicted: camera_from_target that the frames before led to.
            centre_m: (3,) view centre, target frame.
        """
        pose, found = observation.pose, observation.found
        if pose is None or found is None or observation.covariance is None:
            return None
        best, centre = found.best, pose.apply(centre_m)
        rival_rad = rival_m = np.nan
        if found.rival is not None:
            rival_rad = pose.angle_to(found.rival.pose)
            apart_m = found.rival.pose.translation_m - pose.translation_m
            rival_m = float(np.linalg.norm(apart_m))
        innovation = None if predicted is None else pose.delta_from(predicted)
        return cls(
            time_s=time_s,
            range_m=float(np.linalg.norm(centre)),
            covariance=observation.covariance,
            confidence=found.confidence,
            prior=found.prior,
            followed=found.single,
            sketched=found.on_sketch,
            outline=best.outline,
            inner=best.inner,
            visible=best.visible,
            residual_px=best.residual_px,
            light=best.light,
            overshoot=best.overshoot,
            dark=found.dark,
            shading=np.nan if best.shading is None else best.shading,
            votes=np.nan if found.votes is None else found.votes,
            trees=float(observation.weights.sum()),
            margin=found.margin,
            rival_rad=rival_rad,
            rival_m=rival_m,
            innovation=innovation,
            others=_others(found, pose),
        )

    def record(self) -> dict[str, Any]:
        """As a JSON object, all floats in full."""
        return dataclasses.asdict(self)

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Evidence:
        """The evidence of its record."""
        values: dict[str, Any] = {name: np.nan if v is None else v for name, v in record.items()}
        values["covariance"] = np.array(record["covariance"])
        innovation = record["innovation"]
        values["innovation"] = None if innovation is None else np.array(innovation)
        values["others"] = tuple(Other(*other) for other in record.get("others", ()))
        return cls(**values)


def _others(found: Found, pose: Pose) -> tuple[Other, ...]:
    """The other answers that were weighed, with all of the probability that the pose lacks."""
    apart = [
        Other(
            pose.angle_to(one.pose),
            float(np.linalg.norm(one.pose.translation_m - pose.translation_m)),
            one.probability,
        )
        for one in found.weighed
        if pose.angle_to(one.pose) > NEAR_RAD
    ]
    total = sum(other.probability for other in apart)
    if not total > 0.0:
        return ()
    scale = (1.0 - found.posterior) / total
    return tuple(other._replace(probability=scale * other.probability) for other in apart)
