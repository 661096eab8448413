"""From crossings of row anchors and lane paint to whole lines of lanes."""
