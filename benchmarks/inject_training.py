"""Measure how much faults slow the training of a ResNet-18 on images of 256×256 pixels, on the CPU.

    python benchmarks/inject_training.py --workers 2 0 --rounds 3

It needs PyTorch. A `DataLoader` makes batches of synthetic images, and a ResNet-18 (He et al. 2016, doi:10.1109/
CVPR.2016.90) learns to tell which faults are in them. The arms take turns: without faults, with faults that
`vbnfault.torch.Inject` puts into each batch inside the worker, and for comparison batches with faults that nobody
trains on. The table has medians of images a second and of the processor time of all processes, and the median ratio
of each to the arm without faults in the same round. A line says how much of the machine's processor time other
programs took: rates count only where that is little.

The six faults are those of the paper, each in half of the images.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import torch
from inject_beside import PAPER, textured
from torch import nn
from torch.utils.data import DataLoader, Dataset
from turns import in_turns

from vbnfault.torch import Inject

SIZE_PX = 256
KINDS = ("without faults", "with faults", "faults alone")


class Images(Dataset[torch.Tensor]):
    """Hold synthetic RGB images, uint8[channel, y, x], shifted views of one."""

    def __init__(self, count: int) -> None:
        self.whole = torch.from_numpy(textured(2 * SIZE_PX, 3)).permute(2, 0, 1).contiguous()
        self.count = count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, k: int) -> tuple[torch.Tensor, int]:
        y, x = 37 * k % SIZE_PX, 53 * k % SIZE_PX
        return self.whole[:, y : y + SIZE_PX, x : x + SIZE_PX], k


class Collate:
    """Make a batch of images and labels in the worker: which faults are in each image."""

    def __init__(self, inject: Inject | None) -> None:
        self.inject = inject

    def __call__(self, samples: list[tuple[torch.Tensor, int]]) -> tuple[torch.Tensor, torch.Tensor]:
        images = torch.stack([image for image, _ in samples])
        if self.inject is None:
            return images, torch.zeros(len(images), len(PAPER))
        images, masks = self.inject(images, [k for _, k in samples])
        return images, masks.flatten(2).any(dim=2).float()


class Block(nn.Module):
    """Two convolutions of 3×3 pixels and what skips them."""

    def __init__(self, before: int, after: int, stride: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(before, after, 3, stride, 1, bias=False),
            nn.BatchNorm2d(after),
            nn.ReLU(inplace=True),
            nn.Conv2d(after, after, 3, 1, 1, bias=False),
            nn.BatchNorm2d(after),
        )
        self.skip: nn.Module = nn.Identity()
        if stride != 1:
            self.skip = nn.Sequential(nn.Conv2d(before, after, 1, stride, bias=False), nn.BatchNorm2d(after))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return nn.functional.relu(self.body(x) + self.skip(x))


def resnet18(outputs: int) -> nn.Module:
    """Return a ResNet-18; with 1000 outputs it has the 11,689,512 parameters of torchvision's."""
    stem = [nn.Conv2d(3, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64), nn.ReLU(), nn.MaxPool2d(3, 2, 1)]
    blocks = []
    for before, after in ((64, 64), (64, 128), (128, 256), (256, 512)):
        blocks += [Block(before, after, 1 + (before != after)), Block(after, after, 1)]
    return nn.Sequential(*stem, *blocks, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(512, outputs))


def trainer(network: nn.Module) -> Callable[[torch.Tensor, torch.Tensor], None]:
    """Return one step of training."""
    optimizer = torch.optim.SGD(network.parameters(), lr=1e-3, momentum=0.9)

    def step(images: torch.Tensor, labels: torch.Tensor) -> None:
        loss = nn.functional.binary_cross_entropy_with_logits(network(images.float() / 255), labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def arms(options: argparse.Namespace, workers: int) -> Iterator[tuple[str, Callable[[int], Any]]]:
    """Yield name and function of an epoch for each kind of batch."""
    sun = (0.68 * SIZE_PX, 0.3 * SIZE_PX)
    inject = Inject(PAPER, camera={"fov_deg": 65.0, "exposure_s": 0.01}, seed=1, sun=sun)
    step = trainer(resnet18(len(PAPER)))
    for kind in KINDS:
        loader = DataLoader(
            Images(options.batch * options.steps),
            batch_size=options.batch,
            num_workers=workers,
            collate_fn=Collate(None if kind == "without faults" else inject),
            persistent_workers=workers > 0,
            multiprocessing_context=options.start if workers else None,
        )

        def epoch(_round: int, loader: Any = loader, trains: bool = kind != "faults alone") -> None:
            for images, labels in loader:
                if trains:
                    step(images, labels)

        yield kind, epoch


def main() -> None:
    """Measure all arms in turns and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 0])
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--steps", type=int, default=4, help="batches of an epoch")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--start", choices=["fork", "spawn"], default="fork", help="how workers are started")
    options = parser.parse_args()
    warnings.filterwarnings("ignore", message="This DataLoader will create")
    torch.manual_seed(0)
    count = options.batch * options.steps
    print(
        f"ResNet-18 on {count} images of {SIZE_PX} px, batches of {options.batch}, {torch.get_num_threads()} cores"
    )
    print(f"{'':<30}{'images/s':>10}{'ratio':>8}{'CPU ms an image':>18}{'ratio':>8}")
    for workers in options.workers:
        start = time.perf_counter()
        turns = in_turns(dict(arms(options, workers)), options.rounds)
        for kind, wall in turns.wall_ms.items():
            faster, used = turns.rate(kind, "without faults"), turns.processor_ms[kind] / count
            name = f"{kind}, {workers} workers"
            print(f"{name:<30}{1e3 * count / wall:10.1f}{faster[0]:8.2f}{used:18.1f}{faster[1]:8.2f}")
        print(turns, f"({time.perf_counter() - start:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
