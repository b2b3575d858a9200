"""The search for shafts in a small picture: where the two contours of a dark cylinder can be."""
