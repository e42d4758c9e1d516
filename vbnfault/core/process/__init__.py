"""Handle what belongs to the running process: environment, signals, streams, the compiler of kernels."""
