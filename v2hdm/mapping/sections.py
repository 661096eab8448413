"""A long drive, or many of one network, mapped in sections that are adjusted together.

1. Every section, with an overlap of images of its neighbours, is mapped by itself, as a drive would be.
2. Groups of sightings that two sections have in common, image by image, are one marking.
3. The last solves of all sections are joined (:mod:`v2hdm.adjust.sections`), each with the images that are
   its own; this is the joint solve of the drive.
4. Every section classifies its candidates under the joint solve. A marking belongs to the section most of
   whose own images show it.

Sections are jobs of an executor, and lie in files between these steps: no process holds more than one.
"""

from __future__ import annotations

import logging
import pickle
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from v2hdm.adjust import Observations, PoseSigma, Problem, Solution
from v2hdm.adjust.sections.parts import Part, chains_of, parts_of_way
from v2hdm.adjust.sections.solve import Shape, save_part, solve_parts
from v2hdm.association.groups import known_elsewhere
from v2hdm.association.sightings import Sightings, frames_of
from v2hdm.errors import MappingError, WorkerError
from v2hdm.executor import Executor
from v2hdm.lanes.points import ground_by_rig
from v2hdm.mapping.bundle import Bundle, Model, drive_problem, full_model, observations_at
from v2hdm.mapping.conclusion import conclude
from v2hdm.mapping.inputs import Inputs
from v2hdm.mapping.merging import merged
from v2hdm.mapping.methods import optimised_result
from v2hdm.mapping.optimise import initial_rig, larger_noise
from v2hdm.mapping.options import MappingOptions, check_sections
from v2hdm.mapping.recovery import Outcome, clocks_of, optimise, read_outs_of
from v2hdm.mapping.results import MethodResult
from v2hdm.progress import Progress, silent
from v2hdm.records import BoolArray, Drive, FloatArray, Image, ImageDetections, IntArray

_log = logging.getLogger(__name__)

OVERLAP_M = 40.0
"""Distance from a section's frames within which its neighbours' images are its overlap: twice a camera's
reach, so that all who see a marking of the section are there."""

GreyOf = Callable[[Image], NDArray[np.float32]]
DetectionsOf = Callable[[Drive, Sequence[int]], Sequence[ImageDetections]]
"""Detections in some images of a drive, by their indices, numbered in the order of these."""


class Section(NamedTuple):
    """The images (N,) of a section, by their indices in the drive, and which (N,) are its own."""

    images: IntArray
    is_own: BoolArray


def sections_of(drive: Drive, most_m: float) -> list[Section]:
    """Sections of at most ``most_m`` of way; their own images make up the drive."""
    frames = frames_of(drive)
    place = frames.map_from_vehicle[:, :2, 3]
    part_of_frame = parts_of_way(place, frames.session, most_m)
    part_of_image = part_of_frame[frames.frame_of_image]
    place_of_image = place[frames.frame_of_image]
    sections = []
    for number in range(int(part_of_frame.max()) + 1):
        away_m, _ = cKDTree(place[part_of_frame == number]).query(
            place_of_image, distance_upper_bound=OVERLAP_M
        )
        images = np.flatnonzero(np.isfinite(away_m))
        sections.append(Section(images, part_of_image[images] == number))
    return sections


@dataclass(frozen=True)
class _Own:
    """A section mapped by itself, as the others need to know it.

    ``row_key`` (R,) names its sightings, over the whole drive, ``group`` and ``shift`` (R,) their markings;
    ``own_rows`` (G,) counts a group's sightings in the section's own images.
    """

    row_key: IntArray
    group: IntArray
    shift: IntArray
    own_rows: IntArray
    model: Model
    pose_model: str
    observations: int
    chi2_per_dof: float


@dataclass(frozen=True)
class _Common:
    """The results that all sections share: model, scale, and the names of markings.

    Of each group of a section ``names`` (G,) is its marking's over the drive, ``turned`` (G,) by how many
    corners the marking's first is behind the group's, and ``is_ours`` (G,) whether it belongs to the section.
    """

    model: Model
    pose_model: str
    chi2_per_dof: float
    names: tuple[IntArray, ...]
    turned: tuple[IntArray, ...]
    is_ours: tuple[BoolArray, ...]


@dataclass(frozen=True)
class _Work:
    """The steps of a section, whose files are in ``folder``."""

    drive: Drive
    detections_of: DetectionsOf
    cameras: tuple[str, ...]
    options: MappingOptions
    folder: Path
    sections: tuple[Section, ...]
    grey: GreyOf | None = None
    common: _Common | None = None
    is_start: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    in_border: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    shared: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def map_alone(self, number: int, _: Progress = silent) -> _Own:
        """Map a section by itself."""
        section = self.sections[number]
        images = section.images.tolist()
        detections = self.detections_of(self.drive, images)
        drive = replace(self.drive, images=tuple(self.drive.images[image] for image in images))
        inputs = Inputs(drive, detections, self.cameras, self.options, self.grey)
        try:
            outcome, _optimised = optimise(inputs, lambda step: None)
        except MappingError as failure:
            raise MappingError(f"{_named(number, drive)}: {failure}") from None
        self._refuse_corrected(number, inputs, outcome)
        self._keep(number, outcome)
        association = outcome.final.bundle.association
        sightings = outcome.final.sightings
        rows = np.flatnonzero(association.group >= 0)
        is_own = section.is_own[sightings.image[rows]]
        bundle = outcome.final.bundle
        return _Own(
            row_key=_row_keys(section.images[sightings.image])[rows],
            group=association.group[rows],
            shift=association.shift[rows],
            own_rows=np.bincount(association.group[rows][is_own], minlength=association.count),
            model=bundle.model,
            pose_model=outcome.inputs.optimiser.pose_model,
            observations=len(bundle.row),
            chi2_per_dof=bundle.solution.chi2_per_dof,
        )

    def _refuse_corrected(self, number: int, inputs: Inputs, outcome: Outcome) -> None:
        """Raise MappingError where a section alone has corrected what all sections have in common."""
        where = _named(number, inputs.drive)
        for error in outcome.evidence.corrected:
            raise MappingError(
                f"{where}: contradicts the {error.fault.name} of {' and '.join(error.cameras)} by "
                f"{error.sigmas:.0f} sigmas ({error.value:+.3g} {error.fault.unit}); correct it, or map "
                "without sections (map.section_m=0)"
            )
        if outcome.inputs.optimiser.surface is not None:
            raise MappingError(
                f"{where}: its ground is curved, and sections are of level ground; set mapping.ground=plane, "
                "or map without sections (map.section_m=0)"
            )

    def _keep(self, number: int, outcome: Outcome) -> None:
        """Write a section's outcome, without the factors of its solves and what reads images."""
        bare = replace(
            outcome,
            inputs=replace(outcome.inputs, grey=None),
            settled=_bare(outcome.settled),
            bundle=_bare(outcome.bundle),
            final=replace(
                outcome.final,
                bundle=_bare(outcome.final.bundle),
                ungated=_bare(outcome.final.ungated),
                grey=None,
            ),
        )
        with (self.folder / f"section_{number}").open("wb") as stream:
            pickle.dump(bare, stream)

    def _kept(self, number: int) -> Outcome:
        with (self.folder / f"section_{number}").open("rb") as stream:
            outcome = pickle.load(stream)
        assert isinstance(outcome, Outcome)
        inputs = replace(outcome.inputs, grey=self.grey)
        return replace(outcome, inputs=inputs, final=replace(outcome.final, grey=inputs.grey_of_image))

    def cut_part(self, number: int, _: Progress = silent) -> None:
        """Write the part of the joint problem that a section's own images make up."""
        assert self.common is not None
        outcome = self._kept(number)
        final = outcome.final
        sightings = final.sightings
        section = self.sections[number]
        frame_of_image = frames_of(self.drive).frame_of_image[section.images]
        own_frames = np.unique(frame_of_image[section.is_own])
        bundle = final.bundle
        is_own = section.is_own[sightings.image[bundle.row]]
        row = bundle.row[is_own]
        own_corner = bundle.own_corner[is_own]
        corner = self._corner_names(number, bundle)[is_own]
        on_line = known_elsewhere(bundle.association, sightings.valid & final.usable, final.usable)
        observations = observations_at(sightings, (row, own_corner), corner, self.common.model, on_line)
        observations = replace(observations, frame=frame_of_image[sightings.image[row]])
        part = self._part(number, outcome, observations, own_frames)
        save_part(self.folder, number, part)

    def _part(self, number: int, outcome: Outcome, observations: Observations, frames: IntArray) -> Part:
        """The part of ``observations`` whose frames and corners are numbered over the drive."""
        assert self.common is not None
        final = outcome.final
        whole = drive_problem(final.sightings, final.initial_rig, final.cameras, self.common.model)
        # Frames of the section with its overlap, of which its own are taken.
        number_of_local = np.zeros(len(whole.map_from_vehicle), dtype=np.int64)
        local = frames_of(outcome.inputs.drive)
        number_of_local[local.frame_of_image] = frames_of(self.drive).frame_of_image[
            self.sections[number].images
        ]
        at = np.searchsorted(number_of_local, frames)
        cameras, camera = np.unique(observations.camera, return_inverse=True)
        if len(cameras) < len(self.cameras):
            blind = next(name for c, name in enumerate(self.cameras) if c not in cameras)
            where = _named(number, outcome.inputs.drive)
            raise MappingError(
                f"{where}: camera '{blind}' saw no marking twice there; make sections longer (map.section_m)"
            )
        corners, corner = np.unique(observations.corner, return_inverse=True)
        of_cameras = ("intrinsic", "cam_from_vehicle", "centre_vehicle", "centre_sigma_m", "read_out_s")
        of_frames = ("map_from_vehicle", "twist_vehicle", "session")
        rows = dict.fromkeys(of_cameras, cameras) | dict.fromkeys(of_frames, at)
        changes = {
            name: getattr(whole, name)[index]
            for name, index in rows.items()
            if getattr(whole, name) is not None
        }
        changes["cam_from_vehicle"] = final.bundle.rig.cam_from_vehicle[cameras]
        of_part = replace(
            observations, camera=camera, frame=np.searchsorted(frames, observations.frame), corner=corner
        )
        problem = replace(whole, observations=of_part, corner_count=len(corners), **changes)
        return Part(
            problem=problem,
            cameras=cameras,
            frames=frames,
            corners=corners,
            is_start=self.is_start[frames],
            border_frames=np.flatnonzero(self.in_border[frames]),
            border_corners=np.flatnonzero(np.isin(corners // 4, self.shared)),
        )

    def _corner_names(self, number: int, bundle: Bundle) -> IntArray:
        """The corner (K,), over the drive, of each observation of a section's bundle."""
        assert self.common is not None
        names = self.common.names[number][bundle.group]
        turned = self.common.turned[number][bundle.group]
        return np.asarray(4 * names + (bundle.corner + turned) % 4)

    def finish(self, number: int, part: Part, solution: Solution) -> MethodResult:
        """The map of a section's markings under the joint ``solution`` of its ``part``."""
        assert self.common is not None
        outcome = self._kept(number)
        final = outcome.final
        bundle = self._joined(number, final.bundle, part, solution)
        final = replace(final, bundle=bundle)
        optimised = conclude(final, self.options.acceptance)
        is_ours = self.common.is_ours[number][optimised.groups]
        evidence = replace(
            outcome.evidence,
            pose_model=self.common.pose_model,
            clock_s=clocks_of(bundle),
            read_out_s=read_outs_of(bundle),
        )
        outcome = replace(outcome, bundle=bundle, final=final, evidence=evidence)
        markings = tuple(marking for marking, ours in zip(optimised.markings, is_ours, strict=True) if ours)
        excluded = tuple(
            exclusion
            for exclusion, ours in zip(
                optimised.excluded,
                self._are_ours(number, [exclusion.position_map for exclusion in optimised.excluded]),
                strict=True,
            )
            if ours
        )
        ours = replace(optimised, groups=optimised.groups[is_ours], markings=markings, excluded=excluded)
        result = optimised_result(outcome, ours)
        assert result.residuals is not None
        residuals = result.residuals.take(self.common.is_ours[number][bundle.group])
        result = replace(result, joint_covariance=None, residuals=residuals)
        return self._of_own_images(number, result, outcome)

    def _of_own_images(self, number: int, result: MethodResult, outcome: Outcome) -> MethodResult:
        """A section's result without the symbols, lines and poses that are of its neighbours."""
        section = self.sections[number]
        inputs = outcome.inputs
        hd_map = result.hd_map
        lanes = hd_map.lanes
        if lanes:
            detections = [
                image_detections
                for image_detections in inputs.detections
                if section.is_own[image_detections.image]
            ]
            rig = outcome.bundle.rig
            lanes = replace(inputs, detections=detections).find_lanes(
                ground_by_rig(inputs.drive, inputs.cameras, rig, None)
            )
        are_ours = self._are_ours(number, [symbol.outline_map.mean(axis=0) for symbol in hd_map.symbols])
        symbols = tuple(symbol for symbol, ours in zip(hd_map.symbols, are_ours, strict=True) if ours)
        poses = result.poses
        assert poses is not None
        own_paths = {inputs.drive.images[image].path for image in np.flatnonzero(section.is_own).tolist()}
        frame = {path: at for path, at in poses.frame.items() if path in own_paths}
        return replace(
            result,
            hd_map=replace(hd_map, lanes=lanes, symbols=symbols),
            poses=replace(poses, frame=frame),
        )

    def _are_ours(self, number: int, places_map: Sequence[FloatArray]) -> list[bool]:
        """Whether the image nearest to each place (2,) is the section's own."""
        if not len(places_map):
            return []
        section = self.sections[number]
        route = np.array(
            [self.drive.images[image].map_from_vehicle[:2, 3] for image in section.images.tolist()]
        )
        _, nearest = cKDTree(route).query(np.array(places_map))
        return [bool(is_own) for is_own in section.is_own[nearest]]

    def _joined(self, number: int, bundle: Bundle, part: Part, solution: Solution) -> Bundle:
        """A section's bundle under the joint solution; corners that only others' images show are left out."""
        assert self.common is not None
        names = self._corner_names(number, bundle)
        place = np.searchsorted(part.corners, names).clip(max=len(part.corners) - 1)
        is_known = part.corners[place] == names
        count = int(bundle.corner_index.max(initial=-1)) + 1
        index = bundle.corner_index[bundle.group, bundle.corner]
        place_of_corner = np.full(count, -1, dtype=np.int64)
        place_of_corner[index[is_known]] = place[is_known]
        is_solved_jointly = place_of_corner >= 0
        corners_map = bundle.solution.corners_map.copy()
        corners_map[is_solved_jointly] = solution.corners_map[place_of_corner[is_solved_jointly]]
        corner_index = bundle.corner_index.copy()
        is_solved = corner_index >= 0
        corner_index[is_solved] = np.where(
            is_solved_jointly[corner_index[is_solved]], corner_index[is_solved], -1
        )
        rig = bundle.rig
        cam_from_vehicle = rig.cam_from_vehicle.copy()
        cam_from_vehicle[part.cameras] = solution.cam_from_vehicle
        local = frames_of(replace(self.drive, images=tuple(self._images(number))))
        number_of_local = np.zeros(len(rig.map_from_vehicle), dtype=np.int64)
        number_of_local[local.frame_of_image] = frames_of(self.drive).frame_of_image[
            self.sections[number].images
        ]
        map_from_vehicle = rig.map_from_vehicle.copy()
        map_from_vehicle[np.searchsorted(number_of_local, part.frames)] = solution.map_from_vehicle
        joint = JointOfSection(
            solution, place_of_corner, number_of_local[bundle.frames], part.frames, len(bundle.camera_index)
        )
        merged = replace(
            bundle.solution,
            status=solution.status,
            cam_from_vehicle=solution.cam_from_vehicle,
            corners_map=corners_map,
            clock_offset_s=solution.clock_offset_s,
            read_out_s=solution.read_out_s,
            chi2_per_dof=self.common.chi2_per_dof,
            gap=solution.gap,
            # What follows asks for these covariances alone, never for the factors that Covariance has.
            covariance=joint,  # type: ignore[arg-type]
        )
        rig = replace(rig, cam_from_vehicle=cam_from_vehicle, map_from_vehicle=map_from_vehicle)
        return replace(bundle, rig=rig, solution=merged, corner_index=corner_index, model=self.common.model)

    def _images(self, number: int) -> list[Image]:
        return [self.drive.images[image] for image in self.sections[number].images.tolist()]


@dataclass(frozen=True)
class JointOfSection:
    """Covariances of a section's bundle from the joint solution of its part; as a solution's own.

    ``place`` (N,) is a corner's place in the part, -1 for none; ``frames`` (J,) are the bundle's,
    ``part_frames`` (F,) the part's, over the drive.
    """

    solution: Solution
    place: IntArray
    frames: IntArray
    part_frames: IntArray
    cameras: int

    def corners(self, groups: IntArray) -> FloatArray:
        """Joint covariances (M, 2 n, 2 n), m^2, of groups (M, n) of corners."""
        return self.solution.covariance.corners(self.place[groups])

    def extrinsic(self) -> FloatArray:
        """Covariance (C, 6, 6) of each camera's left tangent."""
        return self.solution.covariance.extrinsic()

    def clock_s2(self) -> FloatArray:
        """Variances (C, Q), s^2, of clock offsets."""
        return self.solution.covariance.clock_s2()

    def poses(self) -> FloatArray:
        """Variances (J, 6) of the frames' tangents; nan for those that are another section's."""
        out = np.full((len(self.frames), 6), np.nan)
        place = np.searchsorted(self.part_frames, self.frames).clip(max=len(self.part_frames) - 1)
        is_own = self.part_frames[place] == self.frames
        out[is_own] = self.solution.covariance.poses()[place[is_own]]
        return out


def _bare(bundle: Bundle) -> Bundle:
    """A bundle without the factors of its solve, which are large and bound to this process."""
    # Nothing asks for covariances before the joint solution has put its own in this place.
    return replace(bundle, solution=replace(bundle.solution, covariance=None))  # type: ignore[arg-type]


def _named(number: int, drive: Drive) -> str:
    x, y = drive.route_map.mean(axis=0)
    return f"section {number + 1}, about x {x:.0f} m, y {y:.0f} m"


def _row_keys(image: IntArray) -> IntArray:
    """Names (S,) of sightings over the drive: their image's number (S,), and their place in it."""
    begins = np.concatenate([[True], image[1:] != image[:-1]])
    first = np.maximum.accumulate(np.where(begins, np.arange(len(image)), 0))
    return np.asarray(image * (1 << 20) + np.arange(len(image)) - first)


def map_in_sections(
    drive: Drive,
    detections_of: DetectionsOf,
    cameras: Sequence[str],
    options: MappingOptions,
    most_m: float,
    executor: Executor,
    folder: Path,
    progress: Callable[[str, int, int], None] = lambda task, done, total: None,
    grey: GreyOf | None = None,
) -> MethodResult:
    """Map a drive by the joint optimisation in sections of at most ``most_m`` of way, ignoring truth.

    ``folder`` keeps them while this runs; all processes of the ``executor`` must see it. Raises MappingError
    where a section cannot be mapped or would correct an input, AdjustError where sections contradict each
    other, WorkerError where a process died.
    """
    check_sections(options)
    sections = tuple(sections_of(drive, most_m))
    _log.info("%d sections of at most %.0f m of way", len(sections), most_m)
    work = _Work(drive, detections_of, tuple(cameras), options, folder, sections, grey)
    numbers = list(range(len(sections)))
    alone: list[_Own] = _all(executor, work.map_alone, numbers, partial(progress, "map sections"))
    common, shared = _in_common(alone, sections, options)
    whole = _without_sightings(drive, tuple(cameras), common.model)
    part_of_frame = np.zeros(len(whole.map_from_vehicle), dtype=np.int64)
    frame_of_image = frames_of(drive).frame_of_image
    for number, section in enumerate(sections):
        part_of_frame[frame_of_image[section.images[section.is_own]]] = number
    chains = chains_of(whole, part_of_frame, tuple(common.model.solver.pose_states))
    work = replace(work, common=common, is_start=chains.is_start, in_border=chains.in_border, shared=shared)
    _all(executor, work.cut_part, numbers, partial(progress, "cut sections"))
    shape = Shape.of(whole, common.model.solver)
    results: list[MethodResult] = solve_parts(
        folder, len(sections), chains.links, shape, work.finish, executor, partial(progress, "join sections")
    )
    return merged(results, drive, [section.images[section.is_own] for section in sections])


def _all(
    executor: Executor,
    work: Callable[[int, Progress], Any],
    numbers: Sequence[int],
    progress: Callable[[int, int], None],
) -> list[Any]:
    """The results of all sections, in their order."""
    results: dict[int, Any] = {}
    progress(0, len(numbers))
    with closing(executor.side_by_side(work, numbers)) as outcomes:
        for number, outcome in outcomes:
            if isinstance(outcome, WorkerError):
                raise outcome
            results[number] = outcome
            progress(len(results), len(numbers))
    return [results[number] for number in numbers]


def _in_common(
    alone: Sequence[_Own], sections: Sequence[Section], options: MappingOptions
) -> tuple[_Common, IntArray]:
    """The results that the sections share, and the names of the markings that several of them have."""
    weight = np.array([section.observations for section in alone], dtype=np.float64)
    votes: Counter[str] = Counter()
    for section in alone:
        votes[section.pose_model] += section.observations
    pose_model = votes.most_common(1)[0][0]
    noise: tuple[PoseSigma, ...] = alone[0].model.pose_sigma
    for section in alone[1:]:
        noise = tuple(map(larger_noise, noise, section.model.pose_sigma))
    factors = np.array([section.model.variance_factor for section in alone])
    factor = float(np.exp(np.average(np.log(factors), weights=weight)))
    model = full_model(noise, options, pose_model, factor)
    chi2 = float(np.average([section.chi2_per_dof for section in alone], weights=weight))
    names, turned = _named_markings(alone)
    best: dict[int, tuple[int, int]] = {}
    count: Counter[int] = Counter()
    for number, section in enumerate(alone):
        count.update(names[number].tolist())
        for name, rows in zip(names[number].tolist(), section.own_rows.tolist(), strict=True):
            best[name] = max(best.get(name, (-1, 0)), (rows, -number))
    is_ours = tuple(
        np.array([best[name][1] == -number for name in names[number].tolist()], dtype=np.bool_)
        for number in range(len(alone))
    )
    shared = np.array(sorted(name for name, times in count.items() if times > 1), dtype=np.int64)
    return _Common(model, pose_model, chi2, names, turned, is_ours), shared


def _named_markings(alone: Sequence[_Own]) -> tuple[tuple[IntArray, ...], tuple[IntArray, ...]]:
    """Names (G,) over the drive of each section's groups, and by how many corners these are turned.

    Groups of two sections are one marking if they have sightings in common; of several such pairs those with
    the most count, and no marking has two groups of one section.
    """
    first = np.cumsum([0, *(len(section.own_rows) for section in alone)])
    key = np.concatenate([section.row_key for section in alone])
    group = np.concatenate([section.group + begin for section, begin in zip(alone, first[:-1], strict=True)])
    shift = np.concatenate([section.shift for section in alone])
    section_of = np.repeat(np.arange(len(alone)), np.diff(first))
    order = np.argsort(key, kind="stable")
    key, group, shift = key[order], group[order], shift[order]
    pairs = [np.zeros((0, 3), dtype=np.int64)]
    for step in range(1, len(alone)):
        same = np.flatnonzero(key[step:] == key[:-step]) if len(key) > step else np.zeros(0, dtype=np.int64)
        if not len(same):
            break
        other = same + step
        # Corner c of group a is the sighting's c + shift: that of group b is c + shift_a - shift_b.
        pairs.append(np.stack([group[same], group[other], (shift[same] - shift[other]) % 4], axis=1))
    rows, counts = np.unique(np.concatenate(pairs), axis=0, return_counts=True)
    name = np.arange(first[-1])
    turn = np.zeros(first[-1], dtype=np.int64)  # corner c of the group is corner c + turn of the marking
    members: dict[int, list[int]] = {}
    for a, b, by in rows[np.argsort(-counts, kind="stable")].tolist():
        of_a, of_b = members.get(int(name[a]), [a]), members.get(int(name[b]), [b])
        if name[a] == name[b] or {*section_of[of_a]} & {*section_of[of_b]}:
            continue
        # c of a is c + by of b; the marking's corner is c + turn[a] by a, c + by + turn[b] by b.
        extra = (turn[a] - by - turn[b]) % 4
        for member in of_b:
            turn[member] = (turn[member] + extra) % 4
            name[member] = name[a]
        members[int(name[a])] = [*of_a, *of_b]
    return tuple(np.split(name, first[1:-1])), tuple(np.split(turn, first[1:-1]))


def _without_sightings(drive: Drive, cameras: tuple[str, ...], model: Model) -> Problem:
    """All cameras and frames of a drive with their priors."""
    frames = frames_of(drive)
    none = np.zeros(0, dtype=np.int64)
    sightings = Sightings(
        cameras=cameras,
        stamp_s=frames.stamp_s,
        map_from_vehicle=frames.map_from_vehicle,
        image=none,
        camera=none,
        frame=none,
        kind=none,
        corners_pinhole_px=np.zeros((0, 4, 2)),
        covariance_px=np.zeros((0, 4, 2, 2)),
        valid=np.zeros((0, 4), dtype=np.bool_),
        kinds=(),
        session=frames.session,
        row_share=np.zeros((0, 4)),
        log_odds=np.zeros(0),
    )
    stated = {name: drive.cameras[name] for name in cameras}
    rig = initial_rig(stated, frames.map_from_vehicle)
    return drive_problem(sightings, rig, stated, model)
