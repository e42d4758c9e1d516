"""Create, write, open and verify a dataset, which is one Zarr v3 group (the store).

Only this package imports zarr and obstore. A sample has layers (arrays with one value or vector for each pixel) and
scalars (everything else). These rules protect a store against kills, power loss and bad disks:

- This package reads and encodes the chunk files itself. zarr would drop a chunk of zeros, and a missing chunk reads
  as zeros too; zarr would also compress the neighbours of a rebuilt sample again.
- `files` says where a store is: in a folder (`disk`) or in an object store (`bucket`). On a disk, a file is written
  under a temporary name in the same folder, flushed to the device, and renamed. So each file is either the old or
  the new one, also after a loss of power. `create` makes the whole group this way. A
  killed process leaves `*.partial` files, which `recover` removes.
- The metadata follow from the root attributes alone (`layout`), so every difference can be detected and repaired.
  The root attributes hold a checksum. The group `spare` holds a copy of them and is written before the root.
- A layer is sharded: a chunk holds one sample, and a file holds the chunks of `shard_samples` samples. One task
  owns a shard. Rewriting a shard copies the compressed chunks of the samples that are not rebuilt.
- `crc32c` holds a checksum of every layer and one of all scalars of a sample, over the decoded bytes. A chunk also
  carries Zstd's own checksum. `done` is written last. So damage is detected, and only the damaged samples are
  rebuilt.
"""

from .arrays import EFFECT_RULE, LAYERS, MASK_RULES, REQUIRED_LAYERS, SCALARS, SEMANTIC, Array
from .bucket import OWN, Files, Location, Url, files_of, located
from .check import (
    FaultCounts,
    Planned,
    Problem,
    Report,
    SampleDigests,
    aligned,
    count_faults,
    digest,
    examine,
    examine_shard,
    problem_samples,
    runs,
    spans,
    unplanned_samples,
)
from .codec import Encoded, SharedChunks, encode, mask_union
from .group import check_free, create, is_store, open_dataset, open_store, write_samples
from .layout import drawn_table, event_of, is_sealed, sealed
from .metadata import append_samples, recover
from .opened import Store
from .schema import FORMAT_VERSION, SPLITS, STRATA, VOLATILE_ATTRIBUTES, StoreSpec
from .shards import FetchedSample, ShardReader
