"""Serve a store and the page that shows it, on this machine alone.

The page gets the columns of the listing in one request for all samples, small images for its grid, and layers of a
sample as plain numbers, decoded and compared with their checksums.

The server listens on the loopback interface only. It refuses requests whose header `Host` names another machine, so
that no page of the web can reach it by a name that resolves to this address, and answers only reading requests.
"""

from __future__ import annotations

import json
import math
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, VbnfaultError
from ...core.files import images
from ...core.files.whole_files import plain
from ...store import SEMANTIC, SPLITS, STRATA, ShardReader, Store, drawn_table
from ..contact_sheet import COLOURS, abbreviations, overlay, resized, resized_mask

NOT_KNOWN = 255  # a split without a name, or a severity of a fault that is not injected or draws no number
_BITS = 32
_PAGE = {
    "": ("index.html", "text/html; charset=utf-8"),
    "view.js": ("view.js", "text/javascript; charset=utf-8"),
    "elements.js": ("elements.js", "text/javascript; charset=utf-8"),
    "film.js": ("film.js", "text/javascript; charset=utf-8"),
    "layers.js": ("layers.js", "text/javascript; charset=utf-8"),
    "view.css": ("view.css", "text/css; charset=utf-8"),
}
# nothing of the page comes from elsewhere, and no other page may hold it
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
_SIDES_PX = (160, 240, 320)  # of the small images
_JPEG_QUALITY = 82
_ROOTS = np.sqrt(255 * np.arange(256)).round().astype(np.uint8)  # black and white stay as they are
_MOST_SMALL = 3000  # small images that are kept, of some 10 kB each
_KEPT_S = 60
_PORT_OF_HTTP = 80


class Missing(Exception):
    """Report that a request names nothing that is served."""


class Viewer:
    """Serve a store on the loopback interface.

    Parameters
    ----------
    store
        An open store.
    port
        Port to listen on; 0 takes a free one.

    Raises
    ------
    InputError
        If nothing can listen on the port.
    """

    def __init__(self, store: Store, port: int = 0) -> None:
        self.store = store
        self.listing = Listing(store)
        self._lock = threading.Lock()
        try:
            self.server = _Server(("127.0.0.1", port), _handler(self))
        except OSError as error:
            raise InputError(f"--port {port}: {error.strerror}; 0 takes a free port") from error

    @property
    def port(self) -> int:
        """Return the port."""
        return int(self.server.server_address[1])

    @property
    def url(self) -> str:
        """Return the address of the page."""
        return f"http://127.0.0.1:{self.port}/"

    def serve(self) -> None:
        """Answer requests until `stop` is called; the listing is read meanwhile."""
        threading.Thread(target=self.columns, daemon=True).start()
        try:
            self.server.serve_forever(poll_interval=0.1)
        finally:
            self.server.server_close()

    def stop(self) -> None:
        """End `serve`; may be called by a signal's handler."""
        threading.Thread(target=self.server.shutdown, daemon=True).start()

    # --- what is served -------------------------------------------------------------------------------------

    def answer(self, path: str, query: dict[str, str]) -> tuple[bytes, str, str]:
        """Return body, kind and cache time of a request. Raises Missing."""
        if path in _PAGE:
            name, kind = _PAGE[path]
            return resources.files(__package__).joinpath("page", name).read_bytes(), kind, "no-cache"
        what, _, rest = path.removeprefix("api/").partition("/")
        routes: dict[str, Callable[[], tuple[bytes, str]]] = {
            "store": lambda: (_json(self.about), "application/json"),
            "listing": lambda: (self.columns(), "application/octet-stream"),
            "severity": lambda: (self.severities(), "application/octet-stream"),
            "times": lambda: (self.times(), "application/octet-stream"),
            "sample": lambda: (_json(self.sample(_index(rest, self.store.samples))), "application/json"),
            "small": lambda: (self.small(rest, query), "image/jpeg"),
            "layer": lambda: (self.layer(rest), "application/octet-stream"),
        }
        if not path.startswith("api/") or what not in routes:
            raise Missing
        body, kind = routes[what]()
        return body, kind, f"private, max-age={_KEPT_S}" if what == "small" else "no-store"

    def columns(self) -> bytes:
        """Return the columns of the listing; only one thread reads them."""
        with self._lock:
            return self.listing.columns

    def severities(self) -> bytes:
        """Return the severities; only one thread reads them."""
        with self._lock:
            return self.listing.severities

    def times(self) -> bytes:
        """Return the sequences and times; only one thread reads them. Raises Missing without sequences."""
        if not self.store.spec.sequence_names:
            raise Missing
        with self._lock:
            return self.listing.times

    @cached_property
    def about(self) -> dict[str, Any]:
        """Return what the page needs to know of the store."""
        store, spec = self.store, self.store.spec
        short = abbreviations(spec.faults)
        return {
            "title": str(store.attributes.get("title") or ""),
            "name": store.path.name,
            "samples": store.samples,
            "width": spec.width,
            "height": spec.height,
            "faults": [
                {
                    "name": fault,
                    "short": short[fault],
                    "colour": COLOURS[k % len(COLOURS)],
                    "localised": fault in (spec.localised_faults or ()),
                    "model": str(store.attributes.get("fault_models", {}).get(fault, "")),
                }
                for k, fault in enumerate(spec.faults)
            ],
            "layers": [
                {
                    "name": name,
                    "dtype": row.dtype,
                    "shape": list(spec.shape(row)),
                    "dims": list(row.dims[1:]),
                    "units": row.units,
                    "about": row.long_name,
                    "names": list(SEMANTIC) if name == "semantic" else list(row.names),
                    "bits": row.bits,
                }
                for name, row in spec.pixel_layers.items()
            ],
            "splits": list(SPLITS),
            "strata": list(STRATA),
            "sequences": list(spec.sequence_names),
        }

    def sample(self, index: int) -> dict[str, Any]:
        """Return every scalar of a sample as JSON-able data, with the names of site, lens and device."""
        store, spec = self.store, self.store.spec
        number, values = index // spec.shard_samples, dict[str, Any]()
        damaged = []
        for name, row in spec.scalars.items():
            try:
                value = store.column(name, number)[index - store.shard(number).start]
            except FileNotFoundError:
                return {"index": index, "finished": False}
            except (OSError, ValueError):
                damaged.append(name)
                continue
            values[name] = str(value) if row.is_text else plain(value)
            if row.units not in ("1", ""):
                values[name] = {"value": values[name], "units": row.units}
        for name in ("parameters", "proposal"):
            try:
                values[name] = json.loads(
                    values.get(name) or "{}", parse_int=_exact, parse_float=_finite, parse_constant=str
                )
            except (ValueError, RecursionError):
                damaged.append(name)
        names = {
            "site": spec.site_names,
            "lens": spec.lens_names,
            "detector_individual": spec.detector_names,
            "sequence": spec.sequence_names,
        }
        for name, known in names.items():
            k = values.get(name)
            if isinstance(k, int) and 0 <= k < len(known):
                values[name] = known[k]
        if isinstance(values.get("stratum"), int):
            values["stratum"] = STRATA[values["stratum"]] if values["stratum"] < len(STRATA) else "?"
        return {"index": index, "finished": True, "damaged": damaged, "values": values}

    def pixels(self, name: str, index: int) -> NDArray[Any]:
        """Return a layer of a sample, compared with its checksum. Raises VbnfaultError if it cannot be read."""
        if name not in self.store.spec.pixel_layers:
            raise Missing
        row, reader = self.store.spec.pixel_layers[name], ShardReader(self.store, (name,))
        fetched = reader.fetch(index // self.store.spec.shard_samples, [index])[index]
        out = np.empty(self.store.spec.shape(row), dtype=row.dtype)
        reader.decode(fetched, name, out)
        return out

    def layer(self, rest: str) -> bytes:
        """Return the decoded bytes of a layer of a sample, little-endian: as a browser's typed arrays hold them."""
        name, _, index = rest.partition("/")
        pixels = self.pixels(name, _index(index, self.store.samples))
        return pixels.astype(pixels.dtype.newbyteorder("<"), copy=False).tobytes()

    def small(self, rest: str, query: dict[str, str]) -> bytes:
        """Return a small image of a sample as JPEG, of 160, 240 or 320 px.

        It has its masks if `masks` is 1, and the square root of the values if `brighter` is 1.
        """
        sides = {str(side): side for side in _SIDES_PX}
        if (side := sides.get(query.get("side", "240"))) is None:
            raise Missing
        masks, brighter = (query.get(name) == "1" for name in ("masks", "brighter"))
        return self._small(_index(rest, self.store.samples), side, masks, brighter)

    @cached_property
    def _small(self) -> Callable[[int, int, bool, bool], bytes]:
        """Return what makes small images, and keeps the latest."""
        return lru_cache(_MOST_SMALL)(self._make_small)

    def _make_small(self, index: int, side_px: int, masks: bool, brighter: bool) -> bytes:
        """Return a small image of a sample as JPEG."""
        spec = self.store.spec
        scale = min(1.0, side_px / max(spec.height, spec.width))
        size = (max(1, round(spec.width * scale)), max(1, round(spec.height * scale)))
        rgb = resized(self.pixels("image", index)[..., :3], size)
        if brighter:
            rgb = _ROOTS[rgb]
        if masks and spec.faults:
            small = np.stack([resized_mask(mask, size) for mask in self.pixels("mask", index)])
            localised = [fault in (spec.localised_faults or ()) for fault in spec.faults]
            rgb = overlay(rgb, small, [bool(mask.any()) for mask in small], localised)
        return images.encoded(rgb, ".jpg", _JPEG_QUALITY)


def _index(text: str, samples: int) -> int:
    """Return the index of a sample. Raises Missing if there is no such sample."""
    if not (text.isascii() and text.isdecimal() and len(text) < 12 and int(text) < samples):
        raise Missing
    return int(text)


def _exact(digits: str) -> int | str:
    """Return a whole number, as text where a browser's numbers would round it."""
    return int(digits) if abs(int(digits)) < 2**53 else digits


def _finite(digits: str) -> float | str:
    """Return a number, as text where it is beyond all floats."""
    return float(digits) if math.isfinite(float(digits)) else digits


def _json(value: Any) -> bytes:
    """Return data as JSON."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


# --- the listing ---------------------------------------------------------------------------------------------


class Listing:
    """Read the columns of a listing, each once.

    The page gets them as arrays of numbers, because JSON of 100,000 samples would take seconds.
    """

    def __init__(self, store: Store) -> None:
        self.store = store

    @cached_property
    def columns(self) -> bytes:
        """Return the columns one behind the other.

        First uint32[word, sample]: the bits of the injected faults, 32 classes a word. Then uint8[3, sample]: the
        index of the split in `SPLITS` (255 for another name), the index of the stratum, and 1 where the sample is
        finished.
        """
        store, faults = self.store, len(self.store.spec.faults)
        words = np.zeros((-(-faults // _BITS), store.samples), dtype="<u4")
        bytes_ = np.zeros((3, store.samples), dtype=np.uint8)
        bytes_[0] = NOT_KNOWN
        begun = store.begun()
        bits = np.left_shift(np.uint32(1), np.arange(faults, dtype=np.uint32) % _BITS)
        for number, values in self._column("injected", begun):
            for word in range(len(words)):
                part = values[:, word * _BITS : (word + 1) * _BITS].astype(bool)
                of_word = bits[word * _BITS : (word + 1) * _BITS]
                words[word, _span(store, number)] = (part * of_word).sum(axis=1, dtype=np.uint32)
        index = {name: k for k, name in enumerate(SPLITS)}
        for number, values in self._column("split", begun):
            bytes_[0, _span(store, number)] = [index.get(str(name), NOT_KNOWN) for name in values]
        for number, values in self._column("stratum", begun):
            bytes_[1, _span(store, number)] = values
        for number, values in self._column("done", begun):
            bytes_[2, _span(store, number)] = values != 0
        return words.tobytes() + bytes_.tobytes()

    @cached_property
    def severities(self) -> bytes:
        """Return uint8[fault, sample]: how severe each fault is among those of its class, 0 to 254.

        The measure is the number by which the model of the class becomes more severe, as levels of severity name
        it, or else how many entries its longest list of drawn values has, such as grains or flares. Equal numbers
        get the same value; 255: the fault is not injected, or its model draws no number.
        """
        store, faults = self.store, self.store.spec.faults
        keys, begun = _keys(store), store.begun()
        # only what has files takes memory: a store may count more samples than it holds
        start = {number: k * store.spec.shard_samples for k, number in enumerate(begun)}
        index = np.concatenate([np.array(store.shard(n)) for n in begun]) if begun else np.zeros(0, dtype=np.int64)
        measured = np.full((len(faults), len(index)), np.nan)
        for number, texts in self._column("parameters", begun):
            first = start[number]
            for offset, text in enumerate(texts):
                try:
                    drawn = drawn_table(text)
                except ValueError:
                    continue
                for k, fault in enumerate(faults):
                    if isinstance(drawn.get(fault), dict):
                        measured[k, first + offset] = _measure(drawn[fault], *keys[k])
        ranked = np.full((len(faults), store.samples), NOT_KNOWN, dtype=np.uint8)
        for k, row in enumerate(measured):
            known = np.flatnonzero(np.isfinite(row))
            values, position = np.unique(row[known], return_inverse=True)
            if len(values) > 1:
                counts = np.bincount(position)
                middle = np.cumsum(counts) - (counts + 1) / 2
                ranked[k, index[known]] = np.round(254 * middle / (len(known) - 1)).astype(np.uint8)[position]
        return ranked.tobytes()

    @cached_property
    def times(self) -> bytes:
        """Return time in the sequence in s, float64[sample], and the sequence, int32[sample], -1 if unreadable."""
        store, begun = self.store, self.store.begun()
        time_s, sequence = np.zeros(store.samples, dtype="<f8"), np.full(store.samples, -1, dtype="<i4")
        for name, column in (("time_s", time_s), ("sequence", sequence)):
            for number, values in self._column(name, begun):
                column[_span(store, number)] = values
        return time_s.tobytes() + sequence.tobytes()

    def _column(self, name: str, numbers: Sequence[int]) -> Iterator[tuple[int, NDArray[Any]]]:
        """Yield a scalar of each shard that can be read; equal files are decoded once."""
        store, decoded = self.store, dict[bytes, NDArray[Any]]()
        if store.spec.empty(name):
            return
        last = store.shards - 1
        most_bytes = store.most_bytes(name)
        contents = store.files.read_each([(store.file_name(name, number), most_bytes) for number in numbers])
        for number, content in zip(numbers, contents, strict=True):
            if isinstance(content, OSError):
                continue
            values = decoded.get(content)
            try:
                if values is None or number == last:  # the last shard may hold fewer samples
                    values = store.column(name, number)
                    decoded[content] = values
            except (OSError, ValueError):
                continue
            yield number, values


def _span(store: Store, number: int) -> slice:
    """Return the samples of a shard."""
    samples = store.shard(number)
    return slice(samples.start, samples.stop)


def _keys(store: Store) -> list[tuple[str, bool]]:
    """Return for each class the key by which its model becomes more severe, and whether less of it is worse."""
    from ...faults import registry  # not above: it loads every model, which the first image need not wait for

    models, keys = store.attributes.get("fault_models", {}), []
    for fault in store.spec.faults:
        model = registry().get(fault, {}).get(str(models.get(fault, "")))
        severity = getattr(model, "severity", None)
        keys.append(("", False) if severity is None else (severity.key, severity.low > severity.high))
    return keys


def _measure(drawn: Mapping[str, Any], key: str, less_is_worse: bool) -> float:
    """Return the number by which a drawn fault is more severe, NaN without one."""
    value = drawn.get(key)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return -float(value) if less_is_worse else float(value)
    lists = [len(entry) for entry in drawn.values() if isinstance(entry, list)]
    return float(max(lists)) if lists else float("nan")


# --- HTTP ----------------------------------------------------------------------------------------------------


class _Server(ThreadingHTTPServer):
    """Serve each connection in a thread that ends with the process."""

    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing of a connection that ended early."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """Answer one connection to a viewer, which `_handler` sets."""

    viewer: ClassVar[Viewer]

    timeout = 60.0  # seconds that a read, or the sending of a whole answer, may take
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "vbnfault", ""
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        """Answer a request."""
        self._reply(*self._answered())

    do_HEAD = do_GET

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing: a page asks for hundreds of files."""

    def _answered(self) -> tuple[int, bytes, dict[str, str]]:
        """Return status, body and headers."""
        names, port = ("127.0.0.1", "localhost"), self.viewer.port
        # a browser leaves out the port of HTTP
        hosts = {f"{name}:{port}" for name in names}.union(names if port == _PORT_OF_HTTP else ())
        if self.headers.get("Host", "") not in hosts:
            return HTTPStatus.FORBIDDEN, b"this server answers this machine only", {}
        path, _, query = self.path.partition("?")
        try:
            pairs = dict(pair.partition("=")[::2] for pair in query.split("&"))
            body, kind, cache = self.viewer.answer(path.lstrip("/"), pairs)
            return HTTPStatus.OK, body, {"Content-Type": kind, "Cache-Control": cache}
        except Missing:
            return HTTPStatus.NOT_FOUND, b"not found", {}
        except VbnfaultError as error:  # damaged, or not finished: the page shows the sentence
            return HTTPStatus.UNPROCESSABLE_ENTITY, str(error).encode(), {"Content-Type": "text/plain"}

    def _reply(self, status: int, body: bytes, headers: dict[str, str]) -> None:
        """Send an answer."""
        try:
            self.send_response(status)
            for name, value in {**_HEADERS, **headers, "Content-Length": str(len(body))}.items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)
        except OSError:  # the page has scrolled on, or reads no further
            self.close_connection = True


def _handler(viewer: Viewer) -> type[_Handler]:
    """Return the class that answers the requests for a viewer."""
    return type("_HandlerOfViewer", (_Handler,), {"viewer": viewer})
