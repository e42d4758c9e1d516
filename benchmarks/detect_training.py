"""Measure how fast detectors are trained, and how long they wait for their images.

    vbnfault build quickstart --out q256.zarr --samples 400 --set camera.width_px=256 --set camera.height_px=256
    python benchmarks/detect_training.py q256.zarr

It needs PyTorch and torchvision. For each architecture it does some steps as `vbnfault train` does, without a
worker, and prints the processor time and the wall time of one image, the images per second, the fraction of the
wall time in which the network waits for the loader, and the minutes of five epochs of 1,500 images. Wall times
count only where other programs leave the machine alone, so the last column has those minutes with the processor
time spread evenly over the cores. The first steps, in which PyTorch chooses its algorithms, are left out.
"""

from __future__ import annotations

import argparse
import os
import time

import torch
from turns import processor_s

from vbnfault.detect.losses import loss_of
from vbnfault.detect.networks import ARCHITECTURES, Outputs, as_input, new_network, reduced_precision
from vbnfault.detect.training_data import TrainingData

CPU = torch.device("cpu")
IMAGES, EPOCHS = 1500, 5
WARM_UP = 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store")
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--batch-size", type=int, default=8)
    parser.add_argument("--crop-px", type=int, default=256)
    parser.add_argument("--architectures", nargs="*", default=ARCHITECTURES)
    given = parser.parse_args()
    data = TrainingData([given.store], None, "effect", given.crop_px, given.batch_size, 0)
    weights = data.pixel_weights()
    print(f"{torch.get_num_threads()} threads of PyTorch {torch.__version__}, {os.cpu_count()} cores")
    print(
        f"{'architecture':<32}{'cpu ms':>8}{'wall ms':>9}{'images/s':>10}{'waiting':>9}{'5 epochs':>12}"
        f"{'by cpu':>10}"
    )
    for architecture in given.architectures:
        cpu_s, wall_s, waited_s = measured(architecture, data, weights, given.steps)
        total = EPOCHS * IMAGES / 60
        print(
            f"{architecture:<32}{1e3 * cpu_s:>8.0f}{1e3 * wall_s:>9.0f}{1 / wall_s:>10.2f}{waited_s / wall_s:>9.2%}"
            f"{total * wall_s:>8.1f} min{total * cpu_s / os.cpu_count():>6.1f} min"  # type: ignore[operator]
        )


def measured(
    architecture: str, data: TrainingData, weights: torch.Tensor, steps: int
) -> tuple[float, float, float]:
    """Return processor time, wall time and time of waiting for one image, in s."""
    network = new_network(architecture, len(data.classes)).to(memory_format=torch.channels_last).train()
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)
    batches = data.batches(0)
    cpu = wall = waited = 0.0
    for step in range(steps + WARM_UP):
        before, began = processor_s(), time.perf_counter()
        batch = next(batches)
        read = time.perf_counter()
        with reduced_precision(CPU, architecture):
            said: Outputs = network(as_input(batch["image"], CPU))
        said = Outputs(*(value.float() for value in said))
        loss = loss_of(said, batch, weights)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        if step >= WARM_UP:
            cpu += processor_s() - before
            wall += time.perf_counter() - began
            waited += read - began
    images = steps * data.batch_size
    return cpu / images, wall / images, waited / images


if __name__ == "__main__":
    main()
