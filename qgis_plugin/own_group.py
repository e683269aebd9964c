"""Run a module or script as Python would, in a process group of its own: ``own_group.py [-m] NAME [ARGUMENT ...]``.

Programs that it starts are in the group too, so that all can be ended together.
"""

from __future__ import annotations

import os
import runpy
import sys

if __name__ == "__main__":
    if hasattr(os, "setpgid"):  # Windows has no groups
        os.setpgid(0, 0)
    if sys.argv[1] == "-m":
        sys.argv = sys.argv[2:]
        runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
    else:
        sys.argv = sys.argv[1:]
        runpy.run_path(sys.argv[0], run_name="__main__")
