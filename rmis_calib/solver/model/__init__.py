"""The measurement model: what a transform and the other unknowns predict, and how it differs from what was measured."""
