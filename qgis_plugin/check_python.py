"""Is this Python fit for PolyMerge? Run by the interpreter in question; nothing but the standard library.

``check_python.py`` asks whether an environment can be made with it, and ``check_python.py requirements.txt`` whether
it holds what is needed. What is found is printed; where something is missing the exit code is 1, and the last line says
what.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
import sys
from pathlib import Path

OLDEST = (3, 10)


def main(arguments: list[str]) -> int:
    """Print what is found, and return the exit code."""
    version = ".".join(map(str, sys.version_info[:3]))
    print(f"Python {version}")
    if sys.version_info < OLDEST:
        print(f"it is Python {version}, and PolyMerge needs {OLDEST[0]}.{OLDEST[1]} or newer")
        return 1
    missing = lacking(Path(arguments[0])) if arguments else cannot_make_environments()
    if missing:
        print(missing)
    return 1 if missing else 0


def cannot_make_environments() -> str:
    """Say which part of Python is missing; empty where all is there."""
    if all(importlib.util.find_spec(name) for name in ("venv", "ensurepip")):
        return ""
    return "its module venv or ensurepip is missing (Debian and Ubuntu: install python3-venv)"


def lacking(requirements: Path) -> str:
    """Say which libraries are missing or too old; empty where all are there, and print their versions."""
    faults = []
    for line in requirements.read_text(encoding="utf-8").split():
        name, _, oldest = line.partition(">=")
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            faults.append(f"{name} is missing")
            continue
        print(f"{name} {version}")
        if numbers(version) < numbers(oldest):
            faults.append(f"{name} {version} is older than {oldest}")
    return f"{', '.join(faults)}" if faults else ""


def numbers(version: str) -> tuple[int, ...]:
    """Return the numbers of a version, without what follows them: 2.1.0rc1 is 2.1.0."""
    release = re.sub(r"[^\d.].*", "", version)
    return tuple(int(part) for part in re.sub(r"(\.0*)+$", "", release).split(".") if part)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
