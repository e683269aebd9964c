"""Assemble the plugin's zip from the working tree: `python qgis_plugin/package.py [-o polymerge.zip]`.

It needs the standard library only, and the same tree gives the same bytes. The zip mirrors the top of the
repository, so that the plugin's code finds its files in a checkout and in QGIS in the same places.
"""

from __future__ import annotations

import argparse
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

#: The one folder in the zip, which is the name that QGIS imports the plugin by.
PLUGIN = "polymerge"

#: Single files, and folders with the kinds of file that are taken from them. Kinds are named one by one so that nothing
#: that lies about (a journal of SQLite, a backup of an editor) is ever given to others.
FILES = ("LICENSE", "README.md", "metadata.txt")
FOLDERS = {
    "polymerge_core": (".j2", ".py", ".typed"),
    "qgis_plugin": (".py", ".txt"),
    "resources/icons": (".svg",),
    "resources/sample": (".csv", ".gpkg", ".json"),
    "resources/styles": (".qml",),
}
LEFT_OUT = frozenset({"qgis_plugin/package.py"})
NEEDED = ("polymerge_core/__main__.py", "qgis_plugin/__init__.py", "qgis_plugin/requirements.txt")

INIT = '''"""PolyMerge: merges many overlapping, imperfect digitisations of the same lines into one clean map."""

from .qgis_plugin import classFactory

__all__ = ["classFactory"]
'''

#: The earliest time that a zip can hold.
_TIMESTAMP = (1980, 1, 1, 0, 0, 0)
_UNIX = 3
_READABLE = 0o100644 << 16


def contents(root: Path) -> dict[str, bytes]:
    """Return what goes into the zip.

    Parameters
    ----------
    root : Path
        Top folder of the project.

    Returns
    -------
    dict of str to bytes
        Content by the path inside the plugin's folder, sorted by path.

    Raises
    ------
    FileNotFoundError
        If a file or folder that the plugin needs is missing or empty.
    """
    for name in (*FILES, *NEEDED):
        if not (root / name).is_file():
            raise FileNotFoundError(f"{name} is missing in {root}: run this in a complete checkout of the project")
    found = {"__init__.py": INIT.encode()}
    for name in FILES:
        found[name] = (root / name).read_bytes()
    for folder, kinds in FOLDERS.items():
        members = [path for path in (root / folder).rglob("*") if path.suffix in kinds and _belongs(path, root)]
        if not members:
            raise FileNotFoundError(f"{folder} is missing or empty in {root}: run this in a complete checkout")
        found.update({path.relative_to(root).as_posix(): path.read_bytes() for path in members})
    return dict(sorted(found.items()))


def _belongs(path: Path, root: Path) -> bool:
    inside = path.relative_to(root)
    hidden = any(part.startswith(".") or part == "__pycache__" for part in inside.parts)
    return path.is_file() and not hidden and inside.as_posix() not in LEFT_OUT


def write(path: Path, files: dict[str, bytes]) -> None:
    """Write the zip, so that an interrupt leaves the old one or the new one.

    Parameters
    ----------
    path : Path
        The zip; an existing one is replaced.
    files : dict of str to bytes
        Content by the path inside the plugin's folder.
    """
    half = path.with_name(f".{path.name}.part")
    with zipfile.ZipFile(half, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(f"{PLUGIN}/{name}", _TIMESTAMP)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system, entry.external_attr = _UNIX, _READABLE
            archive.writestr(entry, content)
    half.replace(path)


def main(arguments: list[str] | None = None) -> int:
    """Assemble the zip; return the exit status."""
    parser = argparse.ArgumentParser(description="Assemble the zip of the QGIS plugin.")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "polymerge.zip", help="the zip (%(default)s)")
    output: Path = parser.parse_args(arguments).output
    try:
        files = contents(ROOT)
        write(output, files)
    except OSError as error:
        print(f"polymerge.zip was not made: {error}", file=sys.stderr)
        return 1
    print(f"wrote {output}: {len(files)} files, {output.stat().st_size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
