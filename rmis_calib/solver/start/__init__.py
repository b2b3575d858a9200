"""Starting points: from sums over the axis lines, from contours, ends and head points, without any prior knowledge."""
