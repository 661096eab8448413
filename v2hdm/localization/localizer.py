"""The localiser: takes the newest detections and the odometry, gives the vehicle's pose and its bounds."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from v2hdm.doors import checked
from v2hdm.errors import ConfigError, MapFileError
from v2hdm.localization.agreement import Agreement, Pace, detected
from v2hdm.localization.antenna import Antenna, Fix, with_fix
from v2hdm.localization.areas import AreaMap, with_areas
from v2hdm.localization.belief import (
    BIAS,
    CAMERA,
    HEADING,
    LATE,
    SCALE,
    VEHICLE,
    Belief,
    bounds,
    foresee,
    loosened,
    perhaps_later,
    pinned,
    predict,
    start,
    with_latest,
)
from v2hdm.localization.joint import Located, Scene, explained, locate
from v2hdm.localization.lines import LineMap, with_lines
from v2hdm.localization.motion import Motion, MotionLog, MotionNoise
from v2hdm.localization.noise import DetectorNoise
from v2hdm.localization.paint import Paint
from v2hdm.localization.places import Place, Prior, vehicle_at
from v2hdm.localization.pose import Pose, Status
from v2hdm.localization.regions import EVERY_FULL, Ahead, Looking, View
from v2hdm.localization.rig import Estimate, Rig
from v2hdm.localization.seeing import Look, Sighted, hulls_of_areas, pieces_of_lines, sighted
from v2hdm.localization.starting import Quest
from v2hdm.localization.way import Way
from v2hdm.records import BoolArray, Calibration, FloatArray, HDMap

_LAG_S = 1.0  # images may be this late, s
_NO_IMAGE_S = 1.0  # time without an image, s, after which a reason says so
_FUTURE_S = 2.0  # a stamp farther ahead of the odometry, s, comes from another clock
# With a larger standard deviation of the place the vehicle does not know where it is: half a dash's gap.
_LOST_M = 0.3
_MOST_FEATURES = 36  # markings, stretches of lines and areas whose places' errors are states: those seen last
_STARTED = 4  # number of images after the start that must agree before the place is sure
_START_SIGMA = np.array([0.25, 0.25, np.deg2rad(1.5)])  # standard deviations of a place found, m, m, rad
_UNSTATED = np.diag(np.square([0.01, 0.01, 0.01, *(3 * [np.deg2rad(0.05)])]))  # where a calibration has none
_AGAIN_SIGMA_M = 4.0  # standard deviation of a lost vehicle's place when the search begins again, m
_AGAIN_SIGMA_RAD = 0.2  # standard deviation of its heading then, rad
_TURNED_RAD = np.deg2rad(1.0)  # standard deviation of the turn of a camera that was pushed
_LOOSENED_RAD = np.deg2rad(0.2)  # standard deviation of the turn of a mounting that turned slowly
_PINNED_RAD = np.deg2rad(0.01)  # standard deviation of the other mountings' turn meanwhile
_BEFORE_S = 0.25  # a mounting may have turned this long before it was noticed, s
_LATER_S = 0.1  # standard deviation of an odometry's unexpected delay, s
_UNDECIDED_S = 0.5  # time without a bound after an image with two possible causes, s
_FEW = 0.7  # share of an image's detections under which a turned mounting and a late odometry are tried


class _Past(NamedTuple):
    """A look, and the belief before it."""

    before: Belief
    look: Look


class _Matched(NamedTuple):
    """How much of the map an image showed."""

    markings: int = 0
    lines: int = 0
    areas: int = 0


class Localizer:
    """Finds a vehicle in a map, image by image; needs no more than the base install.

    >>> from v2hdm.localization.motion import Motion
    >>> localizer = Localizer(result.map, result.calibrations)
    >>> localizer.update([], [Motion(0.0, 4.0, 0.0)]).status.value
    'initialising'
    """

    @checked
    def __init__(
        self,
        hd_map: HDMap,
        calibrations: Mapping[str, Calibration],
        prior: Prior | None = None,
        noise: MotionNoise | None = None,
        antenna_m: Sequence[float] = (0.0, 0.0),
        every_full: int = EVERY_FULL,
    ) -> None:
        """Start in a map (frame ``map``, m) with calibrated cameras, by name.

        ``prior`` is a rough position; without one, the whole map is searched.
        ``noise`` is the odometry's; ``antenna_m`` is how far ahead of its origin and to the left the vehicle
        has the antenna of its positions. Of ``every_full`` images of a camera, :meth:`regions` has one
        searched as a whole. Raises MapFileError for a map without markings, or without cameras.
        """
        if every_full < 1:
            raise ConfigError(f"every_full is {every_full}: give a number of images, 1 or more")
        if not hd_map.markings:
            raise MapFileError("the map has no markings; nothing can be localised in it")
        if not calibrations:
            raise MapFileError("no camera is calibrated; give calibration_<camera>.yaml of the map's result")
        self.calibrations = dict(calibrations)
        self.paint = Paint(hd_map)
        self.lines = LineMap(hd_map, self.paint.shared_m2, len(self.paint))
        self.areas = AreaMap(hd_map, self.paint.shared_m2, len(self.paint) + len(self.lines))
        self.noise = noise or MotionNoise()
        self._numbers = {name: number for number, name in enumerate(self.calibrations)}
        covariances = [item.covariance for item in self.calibrations.values()]
        self._mountings = [_UNSTATED if item is None else np.asarray(item) for item in covariances]
        self._log = MotionLog()
        self._antenna = Antenna(np.asarray(antenna_m, dtype=np.float64).reshape(2))
        self._fixes: deque[Fix] = deque()
        self._belief: Belief | None = None
        self._past: deque[_Past] = deque()
        self._search = Quest(prior)
        self._is_sure = False
        self._is_lost = False
        self._confirmed = 0
        self._noise = {name: DetectorNoise() for name in self.calibrations}
        self._agreement = Agreement()
        self._pace = Pace()
        self._rig = Rig(dict(zip(self.calibrations, self._mountings, strict=True)))
        self._turned_s: float | None = None
        self._rig_since_s: float | None = None
        # The time of the last image that a turned mounting and a late odometry both explain.
        self._undecided_s = -np.inf
        self._way = Way(self._log)
        self._pace_reason: str | None = None
        self._reasons: dict[str, str] = {}
        self._matched = _Matched()
        self._looking = Looking(every_full)
        self._images_s: dict[str, float] = {}

    def update(
        self, images: Sequence[Look] = (), motion: Sequence[Motion] = (), fixes: Sequence[Fix] = ()
    ) -> Pose:
        """Take new detections and motions, in any order; return the pose at the newest stamp."""
        for sample in motion:
            problem = self._log.add(Motion(*(float(value) for value in sample)))
            if problem is not None:
                self._forget(problem)
        if self._log.refused:
            self._reasons["odometry"] = (
                f"{self._log.refused} samples of the odometry are impossible for a road vehicle; "
                "state m/s and rad/s"
            )
        self._way.follow_all_but(_LAG_S)
        for fix in sorted(fixes, key=lambda item: item.stamp_s):
            self._fix(fix)
        for look in sorted(images, key=lambda item: item.stamp_s):
            self._take(look)
        return replace(self._pose(), images_s=dict(self._images_s))

    def regions(self, camera: str, stamp_s: float) -> FloatArray | None:
        """The boxes to search in a camera's image at about ``stamp_s``: around markings that the map expects.

        Boxes (R, 4) of left, top, right and bottom, px, for :meth:`v2hdm.detection.road.RoadDetector.detect`.
        None to look everywhere: every few images, and where the place, the map or a mounting is in doubt, few
        markings are expected, or the last look did not show what was.
        """
        return self._ahead(camera, [stamp_s], has_time_later=False)[0].regions_px

    def glance(self, camera: str, stamp_s: float) -> Ahead:
        """As :meth:`regions`, where a whole search can follow a look at parts, as an ``is_second`` look."""
        return self._ahead(camera, [stamp_s], has_time_later=True)[0]

    def ahead(self, camera: str, now_s: float) -> list[Ahead]:
        """As :meth:`glance`, for the next images of a camera at a time; none where nobody knows when."""
        return self._ahead(camera, self._looking.stamps_ahead(camera, now_s), has_time_later=True)

    def _ahead(self, camera: str, stamps_s: Sequence[float], has_time_later: bool) -> list[Ahead]:
        if camera not in self._numbers:
            return [Ahead(stamp_s, None) for stamp_s in stamps_s]

        nothing = Look(camera, 0.0)
        no_quads = sighted(nothing, self.calibrations[camera])
        belief = self._belief if self._is_settled else None

        def view_at(stamp_s: float) -> View | None:
            if belief is None:
                return None
            belief_ahead = self._foreseen(belief, stamp_s)
            return View(belief_ahead, self._scene(belief_ahead, nothing, no_quads))

        newest = self._log.samples[-1:]
        speed_m_s = newest[0].speed_m_s if newest else 0.0
        return self._looking.ahead(camera, stamps_s, view_at, speed_m_s, has_time_later)

    @property
    def _is_settled(self) -> bool:
        """Whether nothing speaks against place, map, odometry and mountings."""
        is_doubted = self._agreement.is_doubtful or self._rig.pushed.is_suspicious
        return self._is_sure and not is_doubted and self._pace_reason is None

    def _take(self, look: Look) -> None:
        """Take a look in its place among those that came before it."""
        if look.camera not in self._numbers:
            names = ", ".join(self._numbers)
            self._reasons["camera"] = (
                f"images of camera '{look.camera}', which has no calibration; there are {names}"
            )
            return
        newest_s = self._log.newest_s
        if newest_s is not None and look.stamp_s > newest_s + _FUTURE_S:
            self._reasons["clock"] = (
                f"an image of {look.camera} is {look.stamp_s - newest_s:.1f} s ahead of the odometry: "
                "is it on the same clock, and still coming?"
            )
            return
        if look.is_second:
            self._look_again(look)
            return
        self._reasons.pop("clock", None)
        self._images_s[look.camera] = max(look.stamp_s, self._images_s.get(look.camera, look.stamp_s))
        later_looks = [past for past in self._past if past.look.stamp_s > look.stamp_s]
        latest_s = max([look.stamp_s, *(past.look.stamp_s for past in self._past)])
        if latest_s - look.stamp_s > _LAG_S:
            self._reasons["late"] = (
                f"an image of {look.camera} came {latest_s - look.stamp_s:.1f} s late; left out"
            )
            return
        if self._belief is None or not later_looks:
            self._see(look, is_new=True)
            return
        self._belief = later_looks[0].before
        while self._past and self._past[-1].look.stamp_s > look.stamp_s:
            self._past.pop()
        self._see(look, is_new=True)
        for past in later_looks:
            self._see(past.look, is_new=False)

    def _look_again(self, look: Look) -> None:
        """Test the map with all of an image; its regions have moved the belief already."""
        self._looking.of(look.camera).note_all(look.stamp_s)
        earlier = [
            past.before
            for past in self._past
            if past.look.camera == look.camera and past.look.stamp_s == look.stamp_s
        ]
        if not earlier or not self._is_sure:
            return
        belief = self._fixed_to(earlier[0], look.stamp_s, has_untold=True)
        scene = self._scene(belief, look, sighted(look, self.calibrations[look.camera]))
        judged = detected(scene, locate(belief, scene))
        self._agreement.note(judged, self._way.length_m, look)

    def _see(self, look: Look, is_new: bool) -> None:
        """Predict the belief to a look and update it with the look."""
        calibration = self.calibrations[look.camera]
        quads = sighted(look, calibration)
        if is_new:
            self._way.follow(look.stamp_s)
            if self._belief is None:
                local = self._way.at(look.stamp_s)
                self._search.patch.add(quads, look.camera, calibration, local, self._way.length_m)
                hulls = hulls_of_areas(look, calibration)
                self._search.words.add(hulls, calibration, local, self._way.length_m)
            since_s = self._pace.since(look.camera)
            pieces = [] if since_s is None else self._log.pieces(since_s, look.stamp_s)
            self._pace_reason = self._pace.note(look, quads, calibration, pieces) or self._pace_reason
        if self._belief is None:
            if is_new:
                self._find(look)
            return
        if look.stamp_s < self._belief.stamp_s:  # of before the place was found
            return
        before = self._belief
        belief = self._fixed_to(before, look.stamp_s, has_untold=True)
        self._past.append(_Past(before, look))
        while self._past[-1].look.stamp_s - self._past[0].look.stamp_s > _LAG_S:
            self._past.popleft()
        self._rig_since_s = None
        self._belief = self._located(belief, look, quads, is_new)
        if self._belief is belief:  # nothing of the map was seen
            self._belief = self._fixed_to(before, look.stamp_s)
        if self._rig_since_s is not None:
            self._let_turn(self._rig_since_s)
        if is_new:
            self._judge(look)
            self._note_mounting(look)

    def _note_mounting(self, look: Look) -> None:
        """Test a camera's mounting after an image of it."""
        belief = self._belief
        if belief is None or not self._is_sure or not self._matched.markings:
            return
        angles = self._angles(look.camera)
        estimate = Estimate(look.stamp_s, belief.mean[angles], belief.covariance(angles))
        change = self._rig.note(look.camera, estimate)
        if change is None or not change.is_slow:
            return
        # This mounting alone has turned; the others are where they were, though they seemed to turn with it.
        belief = loosened(belief, [self._numbers[look.camera]], _LOOSENED_RAD)
        for name, other in self._rig.others(look.camera, change.before.stamp_s).items():
            belief = pinned(belief, self._angles(name), other.turn_rad, _PINNED_RAD)
        self._belief = belief
        self._past.clear()

    def _angles(self, camera: str) -> range:
        """The states of a camera's angles."""
        begin = VEHICLE + CAMERA * self._numbers[camera] + 3
        return range(begin, begin + 3)

    def _let_turn(self, since_s: float) -> None:
        """Go back to before a mounting turned, and repeat the looks since then with free mountings.

        Which of them has turned is not known: what one image took for the vehicle's own roll, free
        mountings and the vehicle's springs, which fade, explain better and better.
        """
        self._turned_s = since_s
        self._rig.loosen(since_s - _BEFORE_S)
        since_then = [past for past in self._past if past.look.stamp_s >= since_s - _BEFORE_S]
        self._belief = loosened(since_then[0].before, list(self._numbers.values()), _TURNED_RAD)
        while self._past and self._past[-1].look.stamp_s >= since_s - _BEFORE_S:
            self._past.pop()
        for past in since_then:
            self._see(past.look, is_new=False)

    def _moved_to(self, belief: Belief, stamp_s: float, has_untold: bool = False) -> Belief:
        if stamp_s <= belief.stamp_s:
            return belief
        pieces = self._log.pieces(belief.stamp_s, stamp_s)
        return predict(belief, pieces, self.noise, self._turning, has_untold)

    def _foreseen(self, belief: Belief, stamp_s: float) -> Belief:
        """The belief at a later time, after the positions until then, that nothing is to correct."""
        latest_s = max((fix.stamp_s for fix in self._fixes if fix.stamp_s <= stamp_s), default=-np.inf)
        belief = self._fixed_to(belief, latest_s)
        if stamp_s <= belief.stamp_s:
            return belief
        pieces = self._log.pieces(belief.stamp_s, stamp_s)
        return foresee(belief, pieces, self.noise, self._turning, has_untold=True)

    @property
    def _turning(self) -> list[int]:
        """The cameras whose mountings are turning slowly."""
        return [self._numbers[turned.camera] for turned in self._rig.turned if turned.is_slow]

    def _located(self, belief: Belief, look: Look, quads: Sighted, is_new: bool) -> Belief:
        """The belief after a look; other causes are tried if it explains too little of the look."""
        noise = self._noise[look.camera]
        scene = self._scene(belief, look, quads)
        located = locate(belief, scene)
        if is_new:
            judged = detected(scene, located)
            by_cause = self._by_cause(belief, look, scene, located, judged.is_judged)
            if by_cause is not located:
                located = by_cause
                judged = detected(scene, located)
            self._agreement.note(judged, self._way.length_m, look)
            if located.misfit_freedom > 0:
                noise.note(located, noise.factor)
        return self._with_lines_and_areas(located, look, scene, is_new)

    def _by_cause(
        self, belief: Belief, look: Look, scene: Scene, located: Located, is_judged: BoolArray
    ) -> Located:
        """A look as it is located; one that is hardly explained, by a later odometry where that does it.

        What a turned mounting explains beyond that is the evidence for it. Where both explain more than
        neither, no bound is stated.
        """
        if not self._is_sure:
            return located
        if is_judged.sum() < 2 or explained(located, is_judged) >= _FEW * is_judged.sum():
            self._rig.pushed.note(look, 0)
            return located
        turned = locate(loosened(belief, list(self._numbers.values()), _TURNED_RAD), scene)
        before = perhaps_later(self._past[-1].before, _LATER_S)
        later = locate(self._fixed_to(before, look.stamp_s, has_untold=True), scene)
        by_none, by_turn, by_lateness = (explained(each, is_judged) for each in (located, turned, later))
        self._rig_since_s = self._rig.pushed.note(look, by_turn - max(by_lateness, by_none))
        if by_lateness <= by_none:
            return located
        self._undecided_s = look.stamp_s
        return later if by_lateness >= by_turn else located

    def _with_lines_and_areas(self, located: Located, look: Look, scene: Scene, is_new: bool) -> Belief:
        """The belief after a look's lines and areas, too, with the features of the map that were seen last.

        Before the place is sure, lines that run alongside would only make a wrong one look right.
        """
        belief = located.belief
        features = located.pairs.marking.tolist()
        matched = _Matched(len(features))
        if self._is_sure:
            pieces_px = pieces_of_lines(look, scene.calibration)
            of_lines = with_lines(belief, scene, self.lines, pieces_px)
            hulls = hulls_of_areas(look, scene.calibration)
            of_areas = with_areas(of_lines.belief, scene, self.areas, hulls)
            belief = of_areas.belief
            features += [*of_lines.features, *of_areas.features]
            matched = _Matched(matched.markings, len(of_lines.observations), len(of_areas.observations))
        if is_new:
            self._matched = matched
            self._looking.of(look.camera).note(look.stamp_s, look.is_whole, matched.markings)
        return with_latest(belief, features, _MOST_FEATURES)

    def _scene(self, belief: Belief, look: Look, quads: Sighted) -> Scene:
        """A look before the map, from about where the vehicle is believed to be."""
        plane = self.paint.ground(belief.mean[:2])
        calibration = self.calibrations[look.camera]
        factor = self._noise[look.camera].factor
        return Scene(quads, self.paint, plane, self._numbers[look.camera], calibration, factor)

    def _find(self, look: Look) -> None:
        """Search for the one place that explains the detections."""
        local = self._way.at(look.stamp_s)
        proposal = self._search.propose(
            look, local, self._way.length_m, self.paint, self.areas, self.calibrations, self._tried
        )
        if proposal.pose is not None:
            self._begin(look.stamp_s, proposal.pose)
        elif proposal.reason is not None:
            self._is_lost = True
            self._reasons["lost"] = proposal.reason

    def _tried(self, place: Place) -> Agreement:
        """How the map explains the last images, seen from a place."""
        looks = self._search.looks
        pose = vehicle_at(place.map_from_local, self._way.at(looks[0].stamp_s))
        belief = start(looks[0].stamp_s, pose, _START_SIGMA, self._mountings, self.noise)
        agreement = Agreement()
        for look in looks:
            quads = sighted(look, self.calibrations[look.camera])
            belief = self._moved_to(belief, look.stamp_s)
            scene = self._scene(belief, look, quads)
            located = locate(belief, scene)
            belief = located.belief
            agreement.note(detected(scene, located), self._way.length_m, look)
        return agreement

    def _begin(self, stamp_s: float, pose: FloatArray) -> None:
        self._belief = start(stamp_s, pose, _START_SIGMA, self._mountings, self.noise)
        self._past.clear()
        self._agreement = Agreement()
        self._confirmed = 0
        self._is_sure = self._is_lost = False
        self._turned_s = None
        self._fixes.clear()
        self._reasons.pop("lost", None)

    def _judge(self, look: Look) -> None:
        """Test whether the belief still explains the looks."""
        assert self._belief is not None
        if not self._is_sure:
            self._confirmed += self._matched.markings >= 2
            if self._confirmed >= _STARTED and self._belief.sigma_m < _LOST_M and not self._agreement.differs:
                self._is_sure = True
            elif self._agreement.differs:
                self._forget("what is seen after the start does not fit the map")
            return
        if self._agreement.is_lost:
            self._forget(
                f"the map explains {100 * self._agreement.share:.0f} % of the markings seen in the last "
                "metres"
            )
        elif self._belief.sigma_m > 3.0:
            self._forget("no marking of the map was seen for too long")

    def _forget(self, reason: str) -> None:
        """Drop the belief, and search around its last place."""
        prior = self._search.prior
        if self._belief is not None and self._is_sure:
            pose = self._belief.mean[:3].copy()
            sigma_m = max(_AGAIN_SIGMA_M, self._belief.sigma_m)
            prior = Prior(pose, sigma_m, _AGAIN_SIGMA_RAD)
        local = self._way.pose if self._belief is None else self._way.at(self._belief.stamp_s)
        self._search = Quest(prior, local)
        self._belief = None
        self._past.clear()
        self._agreement = Agreement()
        self._is_lost = True
        self._is_sure = False
        self._reasons["lost"] = reason

    def _fix(self, fix: Fix) -> None:
        """Keep an RTK position until all earlier images have come."""
        belief = self._belief
        if belief is None:
            self._way.follow(fix.stamp_s)
            local = self._way.at(fix.stamp_s)
            self._antenna.note(fix, local)
            self._search.prior = self._antenna.prior(local, self._search.prior)
            self._search.local = local
            return
        self._fixes.append(fix)
        while fix.stamp_s - self._fixes[0].stamp_s > 2 * _LAG_S:
            self._fixes.popleft()
        # Where no image came for long, none that is older will.
        if fix.stamp_s - belief.stamp_s > _LAG_S:
            self._belief = self._fixed_to(belief, fix.stamp_s - _LAG_S)

    def _fixed_to(self, belief: Belief, stamp_s: float, has_untold: bool = False) -> Belief:
        """The belief at a later time, after the positions until then."""
        for fix in sorted(self._fixes, key=lambda item: item.stamp_s):
            if belief.stamp_s < fix.stamp_s <= stamp_s:
                moved_belief = self._moved_to(belief, fix.stamp_s)
                belief, problem = with_fix(
                    moved_belief, fix, self._antenna.ahead_left_m, self.paint.shared_m2
                )
                self._reasons.pop("fix", None)
                if problem is not None:
                    self._reasons["fix"] = problem
        return self._moved_to(belief, stamp_s, has_untold)

    def _missing(self, stamp_s: float) -> dict[str, str]:
        """Sentences on cameras that have sent no image lately."""
        if not self._images_s:
            waited_s = stamp_s - self._log.stamps_s[0] if self._log.stamps_s else 0.0
            return {"images": "no image has come yet"} if waited_s > _NO_IMAGE_S else {}
        return {
            f"images of {camera}": f"no image of {camera} has come for {stamp_s - image_s:.1f} s"
            for camera, image_s in self._images_s.items()
            if stamp_s - image_s > _NO_IMAGE_S
        }

    def _pose_of_search(self, stamp_s: float, reasons: dict[str, str]) -> Pose:
        """The pose while the place is unknown."""
        if (quest := self._search.prior) is not None and not len(self.paint.near(quest.pose[:2], 60.0)):
            reasons["place"] = (
                "no marking of the map lies within 60 m of where the vehicle should be: is it the map of "
                "this site, in these coordinates?"
            )
            self._is_lost = True
        status = Status.LOST if self._is_lost or self._pace_reason else Status.INITIALISING
        return Pose.unknown(stamp_s, status, tuple(reasons.values()))

    def _pose(self) -> Pose:
        """The pose at the newest stamp."""
        stamps = [item for item in (self._log.newest_s, self._way.stamp_s) if item is not None]
        stamp_s = max(stamps, default=0.0)
        reasons = self._reasons | self._missing(stamp_s)
        if self._pace_reason is not None:
            reasons["odometry"] = f"the odometry does not fit the images: {self._pace_reason}"
        if self._belief is None:
            return self._pose_of_search(stamp_s, reasons)
        belief = self._foreseen(self._belief, stamp_s)
        plane = self.paint.ground(belief.mean[:2])
        covariance = belief.covariance([0, 1, 2])
        covariance += np.diag([self.paint.shared_m2, self.paint.shared_m2, self.paint.shared_rad2])
        status = Status.TRACKING if self._is_sure else Status.INITIALISING
        if belief.sigma_m > _LOST_M and self._is_sure:
            status = Status.LOST
            reasons["blind"] = f"no marking was matched for {stamp_s - self._belief.stamp_s:.1f} s or more"
        if self._pace_reason is not None:
            status = Status.LOST
        if self._agreement.differs:
            reasons["map"] = (
                f"the map explains {100 * self._agreement.share:.0f} % of the markings seen in the last m, "
                "and too few of the latest"
            )
        protection = bounds(covariance, float(belief.mean[HEADING]))
        is_undecided = stamp_s - self._undecided_s < _UNDECIDED_S
        if is_undecided:
            reasons["cause"] = (
                "an image did not fit: the odometry is stamped later or earlier than it seemed, or a "
                "camera's mounting has turned; not told apart yet"
            )
        is_suspicious = self._rig.pushed.is_suspicious or is_undecided
        if status != Status.TRACKING or is_suspicious or self._agreement.differs:
            protection = (np.inf, np.inf, np.inf)
        if status == Status.INITIALISING:
            covariance = np.full((3, 3), np.inf)
        if turned := self._rig.reasons:
            reasons |= {f"rig {number}": sentence for number, sentence in enumerate(turned)}
        elif self._turned_s is not None:
            reasons["rig"] = f"a camera's mounting has turned since {self._turned_s:.1f} s"
        motion = (float(np.exp(belief.mean[SCALE])), float(belief.mean[BIAS]), float(belief.mean[LATE]))
        return Pose(
            stamp_s=stamp_s,
            status=status,
            map_from_vehicle=belief.map_from_vehicle(plane),
            covariance=covariance,
            protection_m=protection[:2],
            protection_rad=protection[2],
            motion=motion,
            matched=self._matched.markings,
            reasons=tuple(reasons.values()),
            turned=self._rig.turned,
            matched_lines=self._matched.lines,
            matched_areas=self._matched.areas,
        )
