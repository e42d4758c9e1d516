"""Train on a dataset with PyTorch.

It needs `pip install 'vbnfault[torch]'`::

    from vbnfault.torch import BatchDataset, Loader, SampleDataset

    data = SampleDataset("paper67p.zarr", "train", ["masks"])
    for batch in Loader(BatchDataset(data, batch_size=8), num_workers=2):
        batch["image"], batch["masks"]

Importing this package loads neither PyTorch nor the renderer; each name loads its module of `train` when it is
first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..train.datasets import BatchDataset, SampleDataset, ShardSampler
    from ..train.loader import Loader

__all__ = ["BatchDataset", "Loader", "SampleDataset", "ShardSampler"]


if not TYPE_CHECKING:  # a type checker that saw the function would accept every misspelled name

    def __getattr__(name: str) -> Any:
        """Return a public name from the module that defines it."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        try:
            return getattr(import_module(f"vbnfault.train.{'loader' if name == 'Loader' else 'datasets'}"), name)
        except ModuleNotFoundError as error:
            if error.name != "torch":
                raise
            raise ModuleNotFoundError(
                f"vbnfault.torch.{name} needs PyTorch, which is not installed: pip install 'vbnfault[torch]'",
                name="torch",
            ) from None
