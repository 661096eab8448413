"""Which sightings are of one marking."""
