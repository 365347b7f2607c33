"""The artefact store: references, cache keys and content-addressed artefacts."""

from __future__ import annotations

from extrags.store.artefacts import Store
from extrags.store.canonical import Ref, canonical, digest_of
from extrags.store.integrity import content_digest
from extrags.store.kept import forget_loaded
from extrags.store.manifest import MANIFEST, Manifest
from extrags.store.records import in_work, read_records, write_record
from extrags.store.slot import Slot
from extrags.store.storable import Storable

__all__ = [
    "MANIFEST",
    "Manifest",
    "Ref",
    "Slot",
    "Storable",
    "Store",
    "canonical",
    "content_digest",
    "digest_of",
    "forget_loaded",
    "in_work",
    "read_records",
    "write_record",
]
