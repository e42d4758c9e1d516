"""Read and write files: those that a user names, those of the package, and those that the program writes."""
