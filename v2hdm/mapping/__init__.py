"""From detections to a map: association, the naive strategy, the joint optimisation, the lanes."""
