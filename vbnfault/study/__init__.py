"""Run sensitivity studies: which parameters drive a metric, how much depends on the model, with what confidence.

`spec` reads a study file, `distributions` and `designs` make its points, `run` evaluates them, `indices` computes
indices with intervals, and `results` stores both.

The package itself is callable: `vbnfault.study(...)` is `run.study`, whether or not a module of this package was
imported before, which sets the attribute `study` of `vbnfault` to this package.
"""
