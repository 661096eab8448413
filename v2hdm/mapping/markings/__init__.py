"""From the site model to the outcome: markings, calibrations and how sure they are."""
