"""From a drive's detections to a map: association, joint optimisation, and recovery from wrong inputs."""
