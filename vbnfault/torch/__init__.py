"""Train on a dataset with PyTorch.

It needs `pip install 'vbnfault[torch]'`::

    from vbnfault.torch import BatchDataset, Loader, SampleDataset

    data = SampleDataset("paper67p.zarr", "train", ["masks"])
    for batch in Loader(BatchDataset(data, batch_size=8), num_workers=2):
        batch["image"], batch["masks"]

Importing this package loads neither PyTorch nor the renderer; each name loads its module when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .datasets import BatchDataset, SampleDataset, ShardSampler
    from .loader import Loader

__all__ = ["BatchDataset", "Loader", "SampleDataset", "ShardSampler"]

# public name → the module that defines it; it is loaded when the name is first used
_HOMES = {
    "BatchDataset": "datasets",
    "Loader": "loader",
    "SampleDataset": "datasets",
    "ShardSampler": "datasets",
}


if not TYPE_CHECKING:  # a type checker that saw the function would accept every misspelled name

    def __getattr__(name: str) -> Any:
        """Return a public name from the module that defines it."""
        from ..core.lazy_names import load_name

        try:
            return load_name(__name__, name, _HOMES)
        except ModuleNotFoundError as error:
            if error.name != "torch":
                raise
            raise ModuleNotFoundError(
                f"vbnfault.torch.{name} needs PyTorch, which is not installed: pip install 'vbnfault[torch]'",
                name="torch",
            ) from None
