"""Layers in and out: GeoPackage, ESRI Shapefile, GeoJSON, FlatGeobuf and GeoParquet.

Files are read by what they hold, not by what they are called, and never changed by being read; nothing is
fetched over a network. Outputs are written by `polymerge_core.outputs`, read back and checked before they
replace anything, and come out byte for byte the same for the same layers.
"""

from polymerge_core.io.decoding import LayerInfo
from polymerge_core.io.drivers import FORMATS, LayerWarning
from polymerge_core.io.fields import SHAPEFILE_NAMES
from polymerge_core.io.local_maps import read_local_maps, source_files
from polymerge_core.io.naming import layer_targets
from polymerge_core.io.reading import list_layers, read_layers, read_table
from polymerge_core.io.sources import split_source
from polymerge_core.io.writing import Written, stage_layers, write_layers

__all__ = [
    "FORMATS",
    "SHAPEFILE_NAMES",
    "LayerInfo",
    "LayerWarning",
    "Written",
    "layer_targets",
    "list_layers",
    "read_layers",
    "read_local_maps",
    "read_table",
    "source_files",
    "split_source",
    "stage_layers",
    "write_layers",
]
