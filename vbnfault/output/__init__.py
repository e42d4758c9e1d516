"""Show a dataset, a sample or the straylight of a lens, and write them as files for other programs."""
