"""The dataset: one Zarr v3 group. Its schema, and how it is created, written, opened, verified.

The only importer of zarr. How a store survives what happens to it:

- Chunk files are encoded here, not by zarr, which would drop a chunk of zeros (an absent one reads as zeros
  too) and recompress the neighbours of a sample that is built again. Reads go through zarr, as a user's do.
- Every file is written beside its place, flushed to the device, and renamed into it, so it is either the old or
  the new one, also after a loss of power (`disk`). `create` makes the whole group that way. A kill leaves
  `*.partial` files, which `recover` removes.
- Metadata follow from the root attributes alone (`layout`), so whatever differs is found and mended. The root
  attributes hold a checksum, and the group `spare` holds a copy, written before the root.
- A per-pixel layer is sharded: a chunk is one sample, a file holds `shard_samples` of them. One task owns a
  shard. Whoever rewrites it copies the compressed chunks of the samples it does not rebuild, untouched.
- `crc32c` holds a checksum of every layer and of all scalars of a sample, over decoded bytes; a chunk carries
  Zstd's own checksum besides. `done` is written last. So a lost power supply or a bad disk is found, and
  exactly the samples concerned are rebuilt.
"""

from .check import (
    Planned,
    Problem,
    Report,
    SampleDigests,
    check_shard,
    count_faults,
    digest,
    examine,
    examine_shard,
    problem_samples,
    unplanned_samples,
    verify,
)
from .codec import Encoded, encode, mask_union
from .counts import FaultCounts
from .group import Store, create, is_store, open_store, write_samples
from .labelled import open_dataset
from .metadata import append_samples, recover
from .schema import (
    EFFECT_RULE,
    FORMAT_VERSION,
    LAYERS,
    REQUIRED_LAYERS,
    SCALARS,
    SEMANTIC,
    SPLITS,
    STRATA,
    VOLATILE_ATTRIBUTES,
    Array,
    Member,
    StoreSpec,
)

__all__ = [
    "EFFECT_RULE",
    "FORMAT_VERSION",
    "LAYERS",
    "REQUIRED_LAYERS",
    "SCALARS",
    "SEMANTIC",
    "SPLITS",
    "STRATA",
    "VOLATILE_ATTRIBUTES",
    "Array",
    "Encoded",
    "FaultCounts",
    "Member",
    "Planned",
    "Problem",
    "Report",
    "SampleDigests",
    "Store",
    "StoreSpec",
    "append_samples",
    "check_shard",
    "count_faults",
    "create",
    "digest",
    "encode",
    "examine",
    "examine_shard",
    "is_store",
    "mask_union",
    "open_dataset",
    "open_store",
    "problem_samples",
    "recover",
    "unplanned_samples",
    "verify",
    "write_samples",
]
