"""The stored map: one GeoPackage that is fed local maps, remembers where everything came from, and survives crashes."""

from polymerge_core.store.map_store import MapStore, Update

__all__ = ["MapStore", "Update"]
