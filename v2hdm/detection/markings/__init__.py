"""From paint to markings: propose, fit, judge."""
