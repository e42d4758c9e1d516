"""Load the batches of a `BatchDataset` with worker processes, through epochs, interruptions and lost workers."""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from ..core.errors import InputError, VbnfaultError, shown
from .datasets import Batch, BatchDataset
from .order import checked_epoch
from .slots import Failure, Packed, Slots, slot_size

# slots beyond those that PyTorch fills ahead: one for the loop's own batch, one for the next
_SPARE_SLOTS = 2
_SETS_ITSELF = ("batch_size", "shuffle", "sampler", "batch_sampler", "drop_last", "collate_fn", "dataset")


class Loader:
    """Iterate over the batches of a dataset, an epoch at a time.

    The sequence of batches depends on the seed of the `BatchDataset` alone, not on `num_workers`. Each complete
    iteration advances `epoch`. An iteration that is left early begins the same epoch again, unless a state is
    loaded. If a worker process dies, its batches are read again by new workers, with a warning; if that happens
    twice at the same batch, the iteration ends with one sentence.

    A batch is a dictionary of tensors. It lies in memory that is filled again as soon as no tensor of it is left:
    nothing needs to be copied or released by hand.

    Parameters
    ----------
    batches
        What is read, and in which order.
    num_workers
        Worker processes; 0 reads in this process, with threads.
    pin_memory
        Whether to copy the batches into pinned memory, for a GPU.
    options
        Any other option of `torch.utils.data.DataLoader`, such as `prefetch_factor`, `multiprocessing_context`
        ("spawn" by default for a store in an object store), `worker_init_fn` or `persistent_workers` (True here,
        unlike there).

    Attributes
    ----------
    epoch : int
        The epoch of the next or of the running iteration.
    """

    def __init__(
        self, batches: BatchDataset, *, num_workers: int = 0, pin_memory: bool = False, **options: Any
    ) -> None:
        if not isinstance(batches, BatchDataset):
            raise InputError(f"batches = {shown(batches)}: must be a BatchDataset")
        for name in _SETS_ITSELF:
            if name in options:
                raise InputError(f"{name}: a Loader takes it from its BatchDataset; give it there")
        if type(num_workers) is not int or num_workers < 0:
            raise InputError(f"num_workers = {shown(num_workers)}: must be a whole number of at least 0")
        if num_workers and not isinstance(batches.data.path, Path):  # threads of obstore do not survive a fork
            start = options.setdefault("multiprocessing_context", "spawn")
            if "fork" in (start, getattr(start, "_name", None)):
                raise InputError(
                    "multiprocessing_context = 'fork': forked workers cannot read an object store; must be 'spawn' "
                    f"or 'forkserver' for {batches.data.path}"
                )
        self.batches = batches
        self.epoch = 0
        self._next = 0  # batch of this epoch that the loop gets next
        self._resumes = False
        self._run = 0
        self._pin = pin_memory
        self._workers = num_workers
        # by default a PyTorch loader draws from the program's own random numbers
        own: dict[str, Any] = {"generator": torch.Generator().manual_seed(batches.order.seed)}
        self._options = {**own, **({"persistent_workers": True} if num_workers else {}), **options}
        self._loader: DataLoader[Any] | None = None
        self._slots: Slots | None = None

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return len(self.batches)

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch of the next iteration."""
        self.epoch, self._next, self._resumes = checked_epoch(epoch), 0, False

    def state_dict(self) -> dict[str, Any]:
        """Return plain data from which `load_state_dict` continues with the batch after the last one received."""
        return self.batches.order.state(self.epoch, self._next)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state in the next iteration, with any number of workers.

        Raises InputError if the state belongs to other samples or to another order.
        """
        self.epoch, self._next = self.batches.order.position(state)
        self._resumes = True

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches of the epoch, or the rest of them after a state was loaded.

        Raises VbnfaultError if a sample is damaged or workers keep dying.
        """
        if not self._resumes:
            self._next = 0
        self._resumes = False
        self._run += 1
        run, failed_at = self._run, -1
        while True:
            try:
                for batch in self._received():
                    if run != self._run:
                        raise VbnfaultError("this loader began another iteration; make one loader for each")
                    self._next += 1
                    yield batch
                break
            except _WorkerDied as died:
                where = f"{self.batches.data.path}: {died} before batch {self._next} of epoch {self.epoch}"
                if failed_at == self._next:
                    raise VbnfaultError(
                        f"{where}, twice; nothing is lost: state_dict() continues there, with fewer workers or a "
                        "smaller batch if memory was short"
                    ) from None
                failed_at = self._next
                logging.getLogger("vbnfault").warning(f"{where}; new workers go on from there")
        self.epoch, self._next = self.epoch + 1, 0

    def _received(self) -> Iterator[Batch]:
        """Yield the batches from the next one on, as tensors. Raises _WorkerDied, and the errors of workers."""
        self.batches.set_epoch(self.epoch, self._next)
        if self._loader is None or (self._workers and not self._options.get("persistent_workers")):
            self._loader = self._new_loader()
        slots = self._slots
        assert slots is not None
        slots.free_dropped()
        received: Any = None
        try:
            with _signals_kept():
                received = iter(self._loader)
            while True:
                try:
                    message = next(received)
                except StopIteration:
                    return
                if isinstance(message, Failure):
                    raise message.kind(message.message)
                if isinstance(message, Packed):
                    message = slots.unpacked(message)
                yield _pinned(message) if self._pin else message
                del message  # a slot is free only when no tensor of it is left here either
        except (RuntimeError, EOFError, OSError) as error:
            died = _who_died(error, getattr(received, "_workers", ()))
            if died is None:
                raise
            self._loader = None
            raise _WorkerDied(died) from None

    def _new_loader(self) -> DataLoader[Any]:
        """Return a new PyTorch loader, with new slots for its workers or for this process."""
        ahead = int(self._options.get("prefetch_factor") or 2) if self._workers else 0
        size = slot_size(self.batches.data.targets.buffers(self.batches.order.batch_size))
        self._slots = Slots(max(1, self._workers), ahead + _SPARE_SLOTS, size, shared=self._workers > 0)
        data = _InSlots(self.batches, self._slots)
        return DataLoader(data, batch_size=None, num_workers=self._workers, collate_fn=_as_it_is, **self._options)


class _InSlots(IterableDataset[Any]):
    """Read the batches of a dataset into slots. A worker sends its errors as data."""

    def __init__(self, batches: BatchDataset, slots: Slots) -> None:
        self.batches, self.slots = batches, slots

    def __iter__(self) -> Iterator[Any]:
        try:
            yield from self.batches.read_batches(self.slots)
        except VbnfaultError as error:
            if get_worker_info() is None:
                raise
            yield Failure(type(error), str(error))  # type: ignore[misc]


def _as_it_is(batch: Any) -> Any:
    """Return a batch unchanged: PyTorch would make tensors of its small arrays, each in its own shared memory."""
    return batch


class _WorkerDied(Exception):
    """Report that a worker process ended by itself."""


def _who_died(error: Exception, workers: Sequence[BaseProcess]) -> str | None:
    """Return how a worker died as a clause; None if the error is another one.

    A worker takes with it the tensors that are on their way, so that the main process may meet any error of a
    connection before PyTorch notices the death.
    """
    for worker in workers:
        worker.join(0.1)
        if worker.exitcode:
            how = f"signal {-worker.exitcode}" if worker.exitcode < 0 else f"exit code {worker.exitcode}"
            return f"a loader worker died (process {worker.pid}, {how})"
    lost = isinstance(error, EOFError | ConnectionError) or str(error).startswith("DataLoader worker")
    return "a loader worker died" if lost else None


@contextlib.contextmanager
def _signals_kept() -> Iterator[None]:
    """Keep the handler of SIGCHLD: PyTorch's would raise its error anywhere in the training loop.

    Without it the loader notices a dead worker itself, after at most 5 s of waiting for a batch.
    """
    number = getattr(signal, "SIGCHLD", None)
    if number is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(number)
    yield
    if signal.getsignal(number) is not before and before is not None:
        signal.signal(number, before)


def _pinned(batch: Batch) -> Batch:
    """Return a batch in pinned memory."""
    return {name: value.pin_memory() if isinstance(value, Tensor) else value for name, value in batch.items()}
