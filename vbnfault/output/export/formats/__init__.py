"""Hold the packaged formats of exports: one file for each, which registers itself."""
