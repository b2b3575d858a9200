"""The measurement at full resolution: sub-pixel contour points, the shaft's end, and how sure it is."""
