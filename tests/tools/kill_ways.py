"""The ways to make a dataset that `kills` ends early, and the servers that they need.

A way is a small class; see `kills.Way`. All but retakes and exports make the dataset of `synthetic`. The cluster of
Dask and the server of S3 run in processes of their own, so that the process that forks has no threads.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import signal
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import frames_kit
import synthetic
from conftest import small_scene
from tools import victim
from tools.kills import Place, Running, Step, Way

# What the commands need, except the renderer: a forked process would lack its threads.
import vbnfault.dataset.from_scene
import vbnfault.dataset.retake
from vbnfault import store
from vbnfault.core.quantities import Sample
from vbnfault.dataset.merge import join_stores
from vbnfault.output.export import export_store, formats
from vbnfault.scene import config
from vbnfault.store import bucket

BUCKET = "bucket"


class OneProcess(Way):
    """A build in one process."""

    def run(self, place: Place) -> None:
        """Build."""
        synthetic.run(place.out, samples=place.samples)


class _Workers(Way):
    """A build with workers, which follow the step."""

    def disturb(self, place: Place, step: Step) -> None:
        """Build with workers of which the first one at the event is killed."""
        raise NotImplementedError

    def complete(self, place: Place) -> None:
        """Build what is missing in one process."""
        OneProcess().run(place)

    def count(self, place: Place) -> int:
        """Build, and count the operations of one of two workers, which take turns, by a build in one process."""
        self.run(place)
        other = Place(**{**vars(place), "out": place.shared / "counted"})
        events = OneProcess().count(other) // 2
        shutil.rmtree(other.out)
        return events


class TwoWorkers(_Workers):
    """A build with two workers, one of which is killed."""

    to = "self"

    def run(self, place: Place) -> None:
        """Build."""
        synthetic.run(place.out, samples=place.samples, workers=2)

    def disturb(self, place: Place, step: Step) -> None:
        """Build with workers of which the first one at the event sends the signal."""
        os.environ["VICTIM_PLAN"] = json.dumps({"worker": [step.plan(to=self.to, once=step.once)]})
        self.run(place)


class TwoWorkersParent(TwoWorkers):
    """A build with two workers, one of which kills the command."""

    to = "parent"


@dataclass(frozen=True)
class Following(synthetic.Session):
    """Makes fake samples in a worker that follows a step from its first sample on."""

    step: str = "{}"  # JSON, so that it can be hashed

    def __call__(self) -> Following:
        """Return the session itself."""
        return self

    def simulate(self, index: int) -> Sample:
        """Return a sample."""
        if _followed[:1] != [self.step]:
            if not _followed:
                _followed.extend(["", victim.follow([])])
            _followed[0] = self.step
            _followed[1][:] = [json.loads(self.step)]
        return super().simulate(index)


_followed: list[Any] = []  # by this process: the step as text, and the steps that are left


class OnDask(_Workers):
    """A build on a Dask cluster, one of whose workers is killed."""

    needs = ("scheduler",)

    def run(self, place: Place) -> None:
        """Build."""
        synthetic.run(place.out, samples=place.samples, scheduler=place.scheduler)

    def disturb(self, place: Place, step: Step) -> None:
        """Build with workers of which the first one at the event is killed."""
        session = Following(step=json.dumps(step.plan(once=step.once)))
        synthetic.run(place.out, session, samples=place.samples, scheduler=place.scheduler)


class Ranges(Way):
    """Two builds of a range of shards each, at once in one store, one of which is killed."""

    def run(self, place: Place) -> None:
        """Build the first half."""
        synthetic.run(place.out, samples=place.samples, shard_range=range(_half(place)))

    def beside(self, place: Place) -> Callable[[], None]:
        """Return the build of the second half."""
        return lambda: _build_second_half(place.out, place)

    def complete(self, place: Place) -> None:
        """Build all that is missing."""
        self.run(place)
        OneProcess().run(place)


def _half(place: Place) -> int:
    """Return the number of shards in the first half of the dataset."""
    return max(1, -(-place.samples // 4) // 2)


def _build_second_half(out: Path, place: Place) -> None:
    """Build the second half of the shards."""
    synthetic.run(out, samples=place.samples, shard_range=range(_half(place), -(-place.samples // 4)))


class Merge(Way):
    """A merge of two stores, each of which has half of the shards."""

    variants = ("copy", "move")

    def prepare(self, place: Place) -> None:
        """Build the halves."""
        Ranges().run(Place(**{**vars(place), "out": place.shared / "half0.zarr"}))
        _build_second_half(place.shared / "half1.zarr", place)

    def begin(self, place: Place) -> None:
        """Copy the halves."""
        for k, part in enumerate(self._parts(place)):
            shutil.copytree(place.shared / f"half{k}.zarr", part)

    def _parts(self, place: Place) -> list[Path]:
        return [Path(f"{place.out}-part{k}") for k in range(2)]

    def run(self, place: Place) -> None:
        """Merge."""
        join_stores(self._parts(place), place.out, move=place.variant == "move", progress=False)

    def held(self, place: Place) -> int:
        """Return the number of samples that any of the stores holds."""
        stores = [store.open_store(p) for p in (*self._parts(place), place.out) if store.is_store(p)]
        return len({i for s in stores for n in s.begun() for i, done in s.done(n).items() if done})

    def remove(self, place: Place) -> None:
        """Remove the stores."""
        for part in self._parts(place):
            shutil.rmtree(part)
        super().remove(place)


class InBucket(Way):
    """A build in a bucket of S3, which is killed at a request that writes."""

    needs = ("server",)
    mode = "kill"

    def run(self, place: Place) -> None:
        """Build; requests that fail are repeated once, at once."""
        backoff = {"init_backoff": timedelta(milliseconds=1), "max_backoff": timedelta(milliseconds=9), "base": 2.0}
        bucket.RETRIES = {"max_retries": 1, "retry_timeout": timedelta(seconds=60), "backoff": backoff}
        synthetic.run(place.out, samples=place.samples)

    def complete(self, place: Place) -> None:
        """Build, with the server at peace."""
        _control(place, "none", 0)
        self.run(place)

    def count(self, place: Place) -> int:
        """Build, and return the number of requests that write."""
        _control(place, "none", 0)
        self.run(place)
        return _control(place, "none", 0)

    def disturb(self, place: Place, step: Step) -> None:
        """Build until the server kills this process, or fails; what a torn request wrote is lost."""
        _control(place, "kill-before" if step.torn and self.mode == "kill" else self.mode, step.at)
        self.run(place)

    def held(self, place: Place) -> int:
        """Return the number of finished samples."""
        _control(place, "none", 0)
        return super().held(place)

    def left(self, place: Place) -> list[str]:
        """Return the names of objects that are no part of the data."""
        names = store.files_of(store.located(place.out))._all_names()  # type: ignore[attr-defined]
        return [name for name in names if name.startswith(".vbnfault")]

    def remove(self, place: Place) -> None:
        """Leave the store in the bucket, which ends with its server."""


class BucketFails(InBucket):
    """A build in a bucket of S3 whose server answers 503 from one request on."""

    mode = "fail"


class Retake(Way):
    """A retake of rendered views, with other faults; few of them, since each command starts a renderer."""

    makes_dataset = False

    def _scene(self, seed: int, **more: Any) -> config.Scene:
        sampling = {"samples": 12, "shard_samples": 2, "sites": 2, "seed": seed, **more}
        faults = {"vignetting": {}, "broken_lines": {}}
        table = small_scene(dataset=sampling, camera={"width_px": 48}, faults=faults)
        return config.parse_scene(table, source="kills")

    def prepare(self, place: Place) -> None:
        """Render the views."""
        layers = ["scene_radiance", "depth_m", "normal", "semantic"]
        vbnfault.build(self._scene(1, layers=layers), place.shared / "views.zarr", progress=False)

    def run(self, place: Place) -> None:
        """Take them again."""
        vbnfault.retake(place.shared / "views.zarr", self._scene(2), place.out, progress=False)


class Frames(Way):
    """A build of rendered frames of sequences, with events and faults that need the frame before."""

    variants = ("alone", "workers", "cluster")
    makes_dataset = False
    needs = ("scheduler",)

    def prepare(self, place: Place) -> None:
        """Write the scene, and build it in one process."""
        path = frames_kit.write_scene(place.shared)
        path.write_text("faults.persistence = {}\n" + path.read_text() + frames_kit.EVENTS)
        vbnfault.build(path, place.shared / "frames.zarr", progress=False)

    def run(self, place: Place) -> None:
        """Build."""
        how = {"alone": {}, "workers": {"workers": 2}, "cluster": {"scheduler": place.scheduler}}[place.variant]
        vbnfault.build(place.shared / "scene.toml", place.out, progress=False, **how)

    def report(self, place: Place) -> dict[str, Any]:
        """Return the digest, and whether it is another than that of one process."""
        found = super().report(place)
        if found["digest"] != store.digest(place.shared / "frames.zarr"):
            found["problems"].append("frames differ from those of one process")
        return found


class Export(Way):
    """An export."""

    variants = (*formats(),)
    makes_dataset = False

    def prepare(self, place: Place) -> None:
        """Build what is exported."""
        synthetic.filled(place.shared / "exported.zarr", place.samples)

    def run(self, place: Place) -> None:
        """Export, with as many threads as the name of the folder has digits."""
        workers = sum(c.isdigit() for c in place.out.name)
        export_store(place.shared / "exported.zarr", place.out, place.variant, workers=workers, progress=False)

    def held(self, place: Place) -> int:
        """Return 0: that parts are kept is tested elsewhere."""
        return 0

    def report(self, place: Place) -> dict[str, Any]:
        """Return the digest of the names and contents of all files."""
        total = hashlib.sha256()
        for path in sorted(p for p in place.out.rglob("*") if p.is_file()):
            total.update(
                f"{path.relative_to(place.out)} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode()
            )
        return {"digest": total.hexdigest(), "problems": self.left(place)}


WAYS: dict[str, Way] = {
    "process": OneProcess("one process"),
    "workers": TwoWorkers("two workers, one killed"),
    "parent": TwoWorkersParent("two workers, command killed"),
    "dask": OnDask("Dask, a worker killed"),
    "ranges": Ranges("two --shard-range in one store"),
    "merge": Merge("two stores merged"),
    "bucket": InBucket("S3, command killed"),
    "failing": BucketFails("S3, server fails"),
    "retake": Retake("retake"),
    "frames": Frames("frames of sequences"),
    "export": Export("export"),
}


# --- services ----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def services(names: Sequence[str], folder: Path) -> Iterator[dict[str, str]]:
    """Run what the ways of these names need in processes of their own; yield their addresses."""
    needed = {need for name in names for need in WAYS[name].needs}
    running: list[Running] = []
    addresses: dict[str, str] = {}
    try:
        for need, serve in (("server", _serve_s3), ("scheduler", _serve_dask)):
            if need in needed:
                reader, writer = os.pipe()
                running.append(Running(lambda serve=serve, writer=writer: serve(writer), silent=True))
                os.close(writer)
                with os.fdopen(reader) as pipe:
                    address = json.loads(pipe.readline() or "null")
                if address is None:
                    raise AssertionError(f"{need}: {running.pop().wait()}")
                os.environ.update(address.pop("environment", {}))
                addresses |= address
        yield addresses
    finally:
        for one in running:
            os.kill(one.pid, signal.SIGTERM)
            one.wait()


def _until_terminated(writer: int, address: dict[str, Any]) -> None:
    """Say where a service is, and wait for SIGTERM."""
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    os.write(writer, (json.dumps(address) + "\n").encode())
    os.close(writer)
    signal.sigwait([signal.SIGTERM])


def _serve_dask(writer: int) -> None:
    """Run a cluster of two processes, which are started again when they die."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, memory_limit=0, dashboard_address=None) as cluster:
        _until_terminated(writer, {"scheduler": cluster.scheduler_address})


def _control(place: Place, mode: str, at: int) -> int:
    """Tell the server what to do at its n-th write from now; return how many there were since the last call."""
    with urllib.request.urlopen(f"{place.server}/control/{mode}/{at}/{os.getpid()}") as answer:
        return int(answer.read())


def _serve_s3(writer: int) -> None:
    """Run a server of S3 that obeys `_control`."""
    from s3_server import S3Server

    class Controlled(S3Server):
        """Counts writes, and kills a process or fails from one on."""

        mode, at, pid, writes = "none", 0, 0, 0

        def _answer(self, environ: dict[str, Any], start_response: Any) -> Any:
            _, first, *words = environ["PATH_INFO"].split("/")
            if first != "control":
                return super()._answer(environ, start_response)
            text = str(self.writes).encode()
            self.mode, self.at, self.pid, self.writes = words[0], int(words[1]), int(words[2]), 0
            start_response("200 OK", [("Content-Length", str(len(text)))])
            return [text]

    server = Controlled()

    def is_write(method: str) -> bool:
        return method in ("PUT", "POST", "DELETE")

    def before(method: str, _path: str) -> int | None:
        server.writes += is_write(method)
        if server.mode == "fail" and server.writes >= server.at:
            return 503
        if server.mode == "kill-before" and is_write(method) and server.writes == server.at:
            os.kill(server.pid, signal.SIGKILL)
            return 503
        return None

    def after(method: str, _path: str) -> None:
        if server.mode == "kill" and is_write(method) and server.writes >= server.at:
            server.mode = "none"
            with contextlib.suppress(ProcessLookupError):
                os.kill(server.pid, signal.SIGKILL)

    server.before, server.after = before, after
    _until_terminated(writer, {"server": server.url, "environment": server.environment})
    server.close()
