"""Classes of paint, by the names that files and settings use."""

from __future__ import annotations

from collections.abc import Mapping

DIAMOND = "diamond"
LANE_DASH = "lane_dash"
LANE_LINE = "lane_line"
ARROW = "arrow"
STOP_LINE = "stop_line"
CROSSWALK_BAR = "crosswalk_bar"
CHEVRON = "chevron"
OTHER_PAINT = "other_paint"
TEXT = "text"
BOX = "box"
BICYCLE = "bicycle"

SEEN_ACROSS: Mapping[str, str] = {LANE_DASH: STOP_LINE, STOP_LINE: LANE_DASH}
"""Stripes that look like each other to a camera to the side: there a dash lies across the view."""

# Composed of other paint, without a class of the network:
CROSSWALK = "crosswalk"
DOUBLE_LINE = "double_line"

GIVE_WAY = "give_way"
"""The variety of a stop line that is a row of pieces: of short, broad dashes or of triangles."""

LANE_BOUNDARY = "lane_boundary"
"""Kind of a lane detection that is a whole line, gaps between dashes and hidden parts included."""
