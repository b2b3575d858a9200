"""Pictures and pixels: shrunken canvases, the lens, sampling along lines, fits to points."""
