"""Train on a dataset with PyTorch.

It needs `pip install 'vbnfault[torch]'`::

    from vbnfault.torch import BatchDataset, Loader, SampleDataset

    data = SampleDataset("paper67p.zarr", "train", ["masks"])
    for batch in Loader(BatchDataset(data, batch_size=8), num_workers=2):
        batch["image"], batch["masks"]

Importing this package loads neither PyTorch nor the renderer; each name loads its module when it is first used.
`Inject` puts faults into the images of any training loop.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..inject.transform import Inject
    from ..train.datasets import BatchDataset, SampleDataset, ShardSampler
    from ..train.loader import Loader
    from ..train.windows import WindowDataset

_HOMES = {
    "BatchDataset": "train.datasets",
    "Inject": "inject.transform",
    "Loader": "train.loader",
    "SampleDataset": "train.datasets",
    "ShardSampler": "train.datasets",
    "WindowDataset": "train.windows",
}
__all__ = list(_HOMES)


if not TYPE_CHECKING:  # a type checker that saw the function would accept every misspelled name

    def __getattr__(name: str) -> Any:
        """Return a public name from the module that defines it."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        try:
            return getattr(import_module(f"vbnfault.{_HOMES[name]}"), name)
        except ModuleNotFoundError as error:
            if error.name != "torch":
                raise
            raise ModuleNotFoundError(
                f"vbnfault.torch.{name} needs PyTorch, which is not installed: pip install 'vbnfault[torch]'",
                name="torch",
            ) from None
