"""Camera files of other programs, a module each, read into `io.intrinsics`."""
