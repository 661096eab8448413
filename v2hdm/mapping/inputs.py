"""The inputs of a camera set's optimisation, as given or without one that the drive contradicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from v2hdm.association.ground import views_of
from v2hdm.association.groups import Association
from v2hdm.association.sightings import Rig, Sightings, collect_sightings
from v2hdm.geometry.rigid import with_clock_offsets
from v2hdm.lanes.knots import Knots, find_knots
from v2hdm.lanes.lines import map_lanes
from v2hdm.lanes.points import ImageGround, LaneCloud, collect_lane_points
from v2hdm.mapping.optimise import Optimiser
from v2hdm.mapping.options import MappingOptions
from v2hdm.records import Drive, Image, ImageDetections, Lane
from v2hdm.site.options import JOINT
from v2hdm.site.standing import Grey, Pixels
from v2hdm.surface.surface import Surface

_LOOSE_CENTRE_SIGMA_M = 10.0  # standard deviation of a surveyed axis after its contradiction: uninformative


@dataclass(frozen=True)
class Inputs:
    """Inputs of a camera set, as given or corrected."""

    drive: Drive
    detections: Sequence[ImageDetections]
    cameras: Sequence[str]
    options: MappingOptions
    grey: Callable[[Image], Pixels] | None = None  # reads an image for its grey values

    @property
    def grey_of_image(self) -> Grey | None:
        """Reads grey values by an image's index in the drive; None where images cannot be read."""
        grey = self.grey
        return None if grey is None else lambda image: grey(self.drive.images[image])

    @cached_property
    def sightings(self) -> Sightings:
        """The detections of these cameras as one table."""
        return collect_sightings(self.drive, self.detections, self.cameras)

    @cached_property
    def optimiser(self) -> Optimiser:
        """An optimiser of these inputs, not yet run."""
        drive = self.drive
        options = self.options
        views = views_of(drive, self.cameras)
        return Optimiser(self.sightings, views, drive.cameras, drive.noises, options, drive.road)

    def find_knots(self, rig: Rig, surface: Surface | None) -> Knots | None:
        """Knots of lanes in the adjustment, found under ``rig``; None if there are none."""
        options = self.options.lanes
        if options.model != JOINT:
            return None
        return find_knots(self.drive, self.detections, self.sightings.cameras, rig, surface, options)

    def find_lanes(self, ground: ImageGround) -> tuple[Lane, ...]:
        """Lane lines of what these cameras detected, on a given ground."""
        return map_lanes(self.lane_cloud(ground), self.options.lanes)

    def lane_cloud(self, ground: ImageGround) -> LaneCloud:
        """Points on the lane paint that these cameras detected, on a given ground."""
        jitter_rad = self.drive.pose_noise.roll_pitch_rad
        max_range_m = self.options.lanes.max_range_m
        return collect_lane_points(self.drive, self.detections, ground, max_range_m, jitter_rad)

    def without_markings(self) -> Inputs:
        """The inputs whose sightings are collected, without the markings among their detections.

        These are no more asked for, but take longer to keep and to read again than all else together.
        """
        detections = [replace(in_image, markings=()) for in_image in self.detections]
        bare = replace(self, detections=detections)
        vars(bare).update(sightings=self.sightings, optimiser=self.optimiser)
        return bare

    @cached_property
    def tracks(self) -> Association:
        """Sightings linked from image to image under the initial IPMs."""
        return self.optimiser.initial_tracks()

    def with_clocks(self, later_s: Sequence[Mapping[str, float]]) -> Inputs | None:
        """The inputs with images ``later_s`` later, by session and camera; None without trajectories."""
        drive = self.drive
        if any(session.trajectory is None for session in drive.sessions):
            return None
        now_s = {(image.session, image.camera): image.clock_offset_s for image in drive.images}
        moved = drive
        for session, later in enumerate(later_s):
            offset_s = {
                name: now_s[session, name] + late for name, late in later.items() if (session, name) in now_s
            }
            moved = with_clock_offsets(moved, offset_s, max_gap_s=float("inf"), session=session)
        number = {image.path: n for n, image in enumerate(moved.images)}
        detections = [
            replace(detected, image=number[drive.images[detected.image].path])
            for detected in self.detections
            if drive.images[detected.image].path in number
        ]
        return replace(self, drive=moved, detections=sorted(detections, key=lambda detected: detected.image))

    def without_axis(self, names: Sequence[str], axis: int) -> Inputs | None:
        """The inputs with one axis of these cameras' centres unsurveyed; None if it is already."""
        cameras = dict(self.drive.cameras)
        for name in names:
            prior = cameras[name].centre_prior
            if prior is None or prior.sigma_m[axis] >= _LOOSE_CENTRE_SIGMA_M:
                return None
            sigma_m = prior.sigma_m.copy()
            sigma_m[axis] = _LOOSE_CENTRE_SIGMA_M
            cameras[name] = replace(cameras[name], centre_prior=replace(prior, sigma_m=sigma_m))
        return replace(self, drive=replace(self.drive, cameras=cameras))
