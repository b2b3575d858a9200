"""Joint logs as poses of both arms, and what joint offsets and the clock change about them."""
