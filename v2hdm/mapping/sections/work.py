"""The steps of a section, which are jobs of an executor and leave their results in files."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from v2hdm.adjust import Problem, Solution
from v2hdm.adjust.sections.joined import JoinedCovariance
from v2hdm.adjust.sections.parts import Part
from v2hdm.adjust.sections.rounds import save_part
from v2hdm.adjust.sections.solve import ROUGH_GAP
from v2hdm.adjust.selection import busiest
from v2hdm.association.groups import known_elsewhere
from v2hdm.errors import AdjustError, MappingError
from v2hdm.faults.clock_errors import ClockErrors
from v2hdm.faults.clock_parts import Along, PartSegments, follow_of, segments_of, slopes_of
from v2hdm.geometry.twists import vehicle_twists
from v2hdm.lanes.lines import Path as LanePath
from v2hdm.lanes.lines import paths_of
from v2hdm.lanes.points import ground_by_rig
from v2hdm.mapping.bundle import Bundle, Model, drive_problem, observations_at
from v2hdm.mapping.conclusion import FinalSolve, concluded, proposed
from v2hdm.mapping.inputs import Inputs
from v2hdm.mapping.methods import optimised_result
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.recovery import Examined, Outcome, clocks_of, examine, read_outs_of
from v2hdm.mapping.results import MethodResult
from v2hdm.mapping.sections.common import Alone, Names
from v2hdm.mapping.sections.joint import Fit, Gate, Judged, Passed, Told, final_of, fit_of, judged_of
from v2hdm.mapping.sections.ours import near_corners, of_ours
from v2hdm.mapping.sections.section import Section
from v2hdm.progress import Progress, silent
from v2hdm.records import BoolArray, FloatArray, Image, ImageDetections, IntArray
from v2hdm.site.candidates import Candidates, Counts
from v2hdm.site.markings import Classified
from v2hdm.site.parallax import Parallax
from v2hdm.site.standing import Pixels

GreyOf = Callable[[Image], Pixels]
DetectionsOf = Callable[[Sequence[Image], IntArray], Sequence[ImageDetections]]
"""Detections in some images, whose numbers in the drive are given, too; numbered in the order of these."""


class Ends(NamedTuple):
    """The ends of a section's own frames: whose states no frame before predicts, and which a link has.

    ``along`` says where they are in the whole drive.
    """

    is_start: BoolArray
    is_linked: BoolArray
    along: Along


class Start(NamedTuple):
    """Where a joint solve of a section begins; ``corners`` (N,) are names over the drive, ascending."""

    cam_from_vehicle: FloatArray  # (C, 4, 4)
    map_from_vehicle: FloatArray  # (F, 4, 4) of its own frames
    corners: IntArray
    corners_map: FloatArray  # (N, 2)


class Proposal(NamedTuple):
    """The candidates of a section that are its own, before they are classified."""

    solved: Candidates
    kinds: tuple[str, ...]
    parallax: Parallax
    clock_slopes: FloatArray | None  # of the section's border under errors of clocks; None: there are none


class Places(NamedTuple):
    """Where a section's own candidates are: corners (G, 4, 2), and of which sides ends are known (G, 4)."""

    number: int
    corners_map: FloatArray
    is_end: BoolArray | None = None


class Finished(NamedTuple):
    """The result of a section: all but its lanes, which are joined with those of the others."""

    result: MethodResult
    lanes: list[LanePath]


@dataclass(frozen=True)
class Work:
    """The steps of a section, whose files are in ``folder``.

    ``model`` is that of the joint solve, ``pose_model`` its name, ``chi2_per_dof`` how it fits; ``is_fitted``
    says whether a rough one has placed all. ``fullest`` is the section of most observations, ``clock_root``
    what all say of the errors of clocks.
    """

    detections_of: DetectionsOf
    cameras: tuple[str, ...]
    options: MappingOptions
    folder: Path
    grey: GreyOf | None = None
    model: Model | None = None
    is_fitted: bool = False
    pose_model: str = ""
    chi2_per_dof: float = 1.0
    fullest: int = 0
    clock_root: FloatArray | None = None

    def write(self, name: str, number: int, content: object) -> None:
        """Write what a section, or all together, leave for later steps of it."""
        with (self.folder / f"{name}_{number}").open("wb") as stream:
            pickle.dump(content, stream)

    def read(self, name: str, number: int) -> Any:
        """Read what was written."""
        with (self.folder / f"{name}_{number}").open("rb") as stream:
            return pickle.load(stream)

    def settle(self, number: int, _: Progress = silent) -> Alone:
        """Solve a section by itself, and test its inputs."""
        section: Section = self.read("section", number)
        detections = self.detections_of(section.drive.images, section.images)
        inputs = Inputs(section.drive, detections, self.cameras, self.options)
        try:
            # All sections together are solved again, to the end.
            inputs.optimiser.settled_gap = ROUGH_GAP
            examined = examine(inputs, lambda step: None)
        except MappingError as failure:
            raise MappingError(f"{section.name}: {failure}") from None
        except AdjustError as failure:
            raise AdjustError(f"{section.name}: {failure}") from None
        if examined.inputs.optimiser.surface is not None:
            raise MappingError(
                f"{section.name}: its ground is curved, and sections are of level ground; set "
                "mapping.ground=plane, or map without sections (map.section_m=0)"
            )
        settled = examined.settled
        optimiser = examined.inputs.optimiser
        kept = Examined(examined.inputs.without_markings(), _bare(settled), examined.evidence)
        self.write("examined", number, kept)
        association = settled.association
        rows = np.flatnonzero(association.group >= 0)
        is_own = section.is_own[optimiser.sightings.image[rows]]
        return Alone(
            sighting=section.sighting_names(optimiser.sightings)[rows],
            group=association.group[rows],
            shift=association.shift[rows],
            own_sightings=np.bincount(association.group[rows][is_own], minlength=association.count),
            estimated_sigma=optimiser.estimated_sigma,
            stated_sigma=optimiser.stated_sigma,
            variance_factor=settled.model.variance_factor,
            observations=len(settled.row),
            own_frames=len(section.own_frames),
            busiest=busiest(settled.problem),
            evidence=examined.evidence,
        )

    def choose(self, number: int, _: Progress = silent) -> tuple[str, dict[str, float]]:
        """The pose model that predicts a section best, and the losses of all models."""
        examined = self._examined(number)
        optimiser = examined.inputs.optimiser
        return optimiser.choose_pose_model(examined.settled), dict(optimiser.held_out)

    def _examined(self, number: int) -> Examined:
        examined = self.read("examined", number)
        assert isinstance(examined, Examined)
        return examined

    def judge(self, number: int, _: Progress = silent) -> Judged:
        """The outliers and noise of a section's own images by its own solve."""
        section: Section = self.read("section", number)
        examined = self._examined(number)
        settled = examined.settled
        names: Names = self.read("names", number)
        chosen = self._own_rows(section, examined)
        observation = section.observation_names(examined.inputs.optimiser.sightings, settled)
        self.write("observed", number, observation[chosen])
        return judged_of(section, settled, names.corners(settled)[chosen])

    def _own_rows(self, section: Section, examined: Examined) -> IntArray:
        """The observations (K,) of the section's own images in its solve, by ascending names."""
        settled = examined.settled
        sightings = examined.inputs.optimiser.sightings
        own_rows = np.flatnonzero(section.is_own[sightings.image[settled.row]])
        return own_rows[np.argsort(section.observation_names(sightings, settled)[own_rows])]

    def cut(self, number: int, _: Progress = silent) -> None:
        """Write the part of the joint problem that a section's own images make up."""
        assert self.model is not None
        section: Section = self.read("section", number)
        examined = self._examined(number)
        settled = examined.settled
        sightings = examined.inputs.optimiser.sightings
        observation = section.observation_names(sightings, settled)
        chosen = self._own_rows(section, examined)[self._gate(number).is_used]
        passed = np.isin(observation, self._passed(section).accepted)
        usable = np.zeros_like(sightings.valid)
        usable[settled.row[passed], settled.own_corner[passed]] = True
        names: Names = self.read("names", number)
        on_line = known_elsewhere(settled.association, sightings.valid & usable, usable)
        at = settled.row[chosen], settled.own_corner[chosen]
        corner = names.corners(settled)[chosen]
        observations = observations_at(sightings, at, corner, self.model, on_line)
        corners, corner = np.unique(observations.corner, return_inverse=True)
        start = self._start(section, examined, names)
        whole = self._whole(section, examined, start)
        cameras, camera = np.unique(observations.camera, return_inverse=True)
        if len(cameras) < len(self.cameras):
            blind = next(name for c, name in enumerate(self.cameras) if c not in cameras)
            raise MappingError(
                f"{section.name}: camera '{blind}' saw no marking twice there; make sections longer "
                "(map.section_m)"
            )
        frame = np.searchsorted(section.own_frames, observations.frame)
        ends: Ends = self.read("ends", number)
        is_shared = names.is_shared[settled.group[chosen]]
        part = Part(
            problem=replace(
                whole,
                observations=replace(observations, camera=camera, frame=frame, corner=corner),
                corner_count=len(corners),
                corners_start=start.corners_map[np.searchsorted(start.corners, corners)],
            ),
            cameras=cameras,
            frames=section.frames[section.own_frames],
            corners=corners,
            is_start=ends.is_start,
            border_frames=np.flatnonzero(ends.is_linked),
            border_corners=np.unique(corner[is_shared]),
        )
        save_part(self.folder, number, part)

    def _passed(self, section: Section) -> Passed:
        """The observations of a section's images and its neighbours' that are no outliers."""
        around = [section.number, *section.neighbours]
        observed: list[IntArray] = [self.read("observed", number) for number in around]
        passed = [self._gate(number) for number in around]
        pairs = list(zip(observed, passed, strict=True))
        return Passed(
            accepted=np.concatenate([observation[gate.is_accepted] for observation, gate in pairs]),
            used=np.concatenate([observation[gate.is_used] for observation, gate in pairs]),
        )

    def _start(self, section: Section, examined: Examined, names: Names) -> Start:
        """Where a joint solve begins: at the rough one, or at the section's own."""
        if self.is_fitted:
            start = self.read("fitted", section.number)
            assert isinstance(start, Start)
            return start
        settled = examined.settled
        corners, first = np.unique(names.corners(settled), return_index=True)
        return Start(
            cam_from_vehicle=settled.rig.cam_from_vehicle,
            map_from_vehicle=settled.rig.map_from_vehicle[section.own_frames],
            corners=corners,
            corners_map=settled.corners_map[settled.group[first], settled.corner[first]],
        )

    def _whole(self, section: Section, examined: Examined, start: Start) -> Problem:
        """All cameras and own frames of a section with their priors, without observations."""
        assert self.model is not None
        optimiser = examined.inputs.optimiser
        sightings = optimiser.sightings
        cameras = {name: section.drive.cameras[name] for name in sightings.cameras}
        whole = drive_problem(sightings, optimiser.initial_rig, cameras, self.model)
        rig = examined.settled.rig
        # Along the adjusted path, whose noise would else pass for motion.
        twists = vehicle_twists(rig.map_from_vehicle, sightings.stamp_s, sightings.session)
        frames = section.own_frames
        return replace(
            whole,
            cam_from_vehicle=start.cam_from_vehicle,
            map_from_vehicle=whole.map_from_vehicle[frames],
            poses_start=start.map_from_vehicle,
            session=None if whole.session is None else whole.session[frames],
            twist_vehicle=twists[frames],
        )

    def _gate(self, number: int) -> Gate:
        gate = self.read("gate", number)
        assert isinstance(gate, Gate)
        return gate

    def fit(self, number: int, part: Part, solution: Solution) -> Fit:
        """How the observations of a section's own images fit a rough solve of all sections."""
        start = Start(
            solution.cam_from_vehicle, solution.map_from_vehicle, part.corners, solution.corners_map
        )
        self.write("fitted", number, start)
        return fit_of(part, solution)

    def tell(self, number: int, part: Part, solution: Solution) -> Fit:
        """Keep what a section's own images are in a joint solve."""
        observed: IntArray = self.read("observed", number)
        told = Told(
            frame=part.frames,
            map_from_vehicle=solution.map_from_vehicle,
            observation=observed[self._gate(number).is_used],
            residual_px=solution.residual_px,
            mahalanobis2=solution.mahalanobis2,
        )
        self.write("told", number, told)
        return fit_of(part, solution)

    def propose(self, number: int, part: Part, solution: Solution) -> Proposal:
        """The candidates of a section under the joint solution."""
        section: Section = self.read("section", number)
        names: Names = self.read("names", number)
        told: list[Told] = [self.read("told", other) for other in (number, *section.neighbours)]
        joint = part, solution, self.chi2_per_dof
        passed = self._passed(section)
        scatter: FloatArray = self.read("scatter", number)
        final = final_of(section, self._examined(number), names, passed, told, joint, scatter)
        assert self.model is not None
        final = replace(final, bundle=replace(final.bundle, model=self.model))
        ours = names.is_ours
        near = near_corners(final.bundle, ours)
        covariance = _joined(solution).with_pairs(near.first, near.second)
        self.write("pairs", number, covariance.pairs)
        proposal = proposed(of_ours(_with_covariance(final, covariance), ours))
        self.write("final", number, replace(final, bundle=_bare(final.bundle)))
        return Proposal(
            solved=proposal.solved.subset(ours),
            kinds=tuple(final.sightings.kinds[kind] for kind in proposal.kind[ours].tolist()),
            parallax=proposal.parallax.subset(ours),
            clock_slopes=slopes_of(part.problem, solution, section.drive.noises, self._along(number)),
        )

    def _along(self, number: int) -> Along:
        ends: Ends = self.read("ends", number)
        return ends.along

    def weigh_clocks(self, number: int, part: Part, solution: Solution) -> PartSegments:
        """Evidence of a section on the errors of clocks, under which its border makes the steps told."""
        section: Section = self.read("section", number)
        steps: FloatArray = self.read("clock_steps", number)
        return segments_of(part.problem, solution, section.drive.noises, self._along(number), steps)

    def _final(self, number: int) -> FinalSolve:
        final = self.read("final", number)
        assert isinstance(final, FinalSolve)
        return final

    def count(self, places: Places, _: Progress = silent) -> Counts:
        """The sightings of a section's own candidates."""
        ours = self.read("names", places.number).is_ours
        corners_map = np.full((len(ours), 4, 2), np.nan)
        corners_map[ours] = places.corners_map
        return self._final(places.number).counts(corners_map).subset(ours)

    def look(self, places: Places, _: Progress = silent) -> FloatArray:
        """Log-likelihood ratios (G, 4) that something stands beyond ends of a section's own candidates."""
        ours = self.read("names", places.number).is_ours
        corners_map = np.full((len(ours), 4, 2), np.nan)
        corners_map[ours] = places.corners_map
        is_end = np.zeros((len(ours), 4), dtype=np.bool_)
        is_end[ours] = False if places.is_end is None else places.is_end
        grey_of_image = None
        if self.grey is not None:
            section: Section = self.read("section", places.number)
            grey_of_image = partial(_grey_of, self.grey, section.drive.images)
        final = replace(self._final(places.number), grey=grey_of_image)
        odds: FloatArray = final.standing_odds(corners_map, is_end)[ours]
        return odds

    def finish(self, number: int, part: Part, solution: Solution) -> Finished:
        """The map of a section's markings, as all sections together have classified them."""
        section: Section = self.read("section", number)
        names: Names = self.read("names", number)
        examined = self._examined(number)
        covariance = replace(_joined(solution), pairs=self.read("pairs", number))
        final = _with_covariance(self._final(number), covariance)
        bundle = final.bundle
        noises = section.drive.noises
        clocks = None
        if self.clock_root is None:
            noises = ()
        else:
            steps: FloatArray = self.read("clock_steps", number)[:, : len(self.clock_root)]
            clocks = ClockErrors(
                self.clock_root, self._along(number).rising, follow_of(bundle.solution, steps)
            )
        optimised = concluded(final, self.read("classified", number), noises, clocks)
        evidence = replace(
            examined.evidence,
            pose_model=self.pose_model,
            clock_s=clocks_of(bundle),
            read_out_s=read_outs_of(bundle),
            clock_m=optimised.clock_m,
        )
        inputs = examined.inputs
        inputs.optimiser.pose_model = self.pose_model
        outcome = Outcome(inputs, examined.settled, optimised.bundle, evidence, final)
        result = optimised_result(outcome, optimised, with_lanes=False, with_alone=number == self.fullest)
        return Finished(self._of_own_images(section, result, names, bundle), self._lanes(section, outcome))

    def _of_own_images(
        self, section: Section, result: MethodResult, names: Names, bundle: Bundle
    ) -> MethodResult:
        """A section's result without the symbols, residuals and poses that are of its neighbours."""
        symbols = result.hd_map.symbols
        if symbols:
            are_inside = section.is_inside(np.array([symbol.outline_map.mean(axis=0) for symbol in symbols]))
            symbols = tuple(symbol for symbol, inside in zip(symbols, are_inside, strict=True) if inside)
        poses = result.poses
        residuals = result.residuals
        assert poses is not None
        assert residuals is not None
        images = section.drive.images
        own_paths = {images[image].path for image in np.flatnonzero(section.is_own).tolist()}
        has_marking = np.zeros_like(poses.has_marking)
        has_marking[section.own_frames[np.unique(bundle.problem.observations.frame)]] = True
        return replace(
            result,
            hd_map=replace(result.hd_map, symbols=symbols),
            joint_covariance=None,
            residuals=residuals.take(names.is_ours[bundle.group]),
            poses=replace(
                poses,
                has_marking=has_marking,
                frame={path: at for path, at in poses.frame.items() if path in own_paths},
            ),
        )

    def _lanes(self, section: Section, outcome: Outcome) -> list[LanePath]:
        """Paths of lane paint inside the section, from all images that see it."""
        inputs = outcome.inputs
        ground = ground_by_rig(inputs.drive, inputs.cameras, outcome.bundle.rig, None)
        return paths_of(inputs.lane_cloud(ground), self.options.lanes, section.is_inside)


def classified_of(classified: Classified, rows: IntArray, names: Names, kinds: Sequence[str]) -> Classified:
    """A section's candidates, at ``rows`` of those of all sections; those of others in it are of no kind."""
    count = len(names.is_ours)

    def spread(values: NDArray[Any]) -> NDArray[Any]:
        out = np.zeros((count, *values.shape[1:]), dtype=values.dtype)
        out[names.is_ours] = values[rows]
        return out

    verdict: list[str | None] = ["of another section"] * count
    kind = [kinds[0]] * count
    for group, row in zip(np.flatnonzero(names.is_ours).tolist(), rows.tolist(), strict=True):
        verdict[group] = classified.verdict[row]
        kind[group] = classified.kind[row]
    candidates = classified.candidates
    return Classified(
        kind=tuple(kind),
        candidates=Candidates(spread(candidates.corners_map), spread(candidates.covariance_m2)),
        counts=Counts(**{name: spread(values) for name, values in vars(classified.counts).items()}),
        misfit=spread(classified.misfit),
        verdict=verdict,
    )


def _grey_of(grey: GreyOf, images: Sequence[Image], image: int) -> Pixels:
    return grey(images[image])


def _joined(solution: Solution) -> JoinedCovariance:
    covariance = solution.covariance
    assert isinstance(covariance, JoinedCovariance)
    return covariance


def _with_covariance(final: FinalSolve, covariance: JoinedCovariance) -> FinalSolve:
    bundle = final.bundle
    solution = replace(bundle.solution, covariance=covariance)
    return replace(final, bundle=replace(bundle, solution=solution))


def _bare(bundle: Bundle) -> Bundle:
    return replace(bundle, solution=bundle.solution.without_factors())
