"""Become another program in a process group of its own: ``own_group.py PROGRAM [ARGUMENT ...]``.

All that the program starts is in the group too, so that it can be ended together with it. The program keeps the id of
this process, which is then also the group's.
"""

from __future__ import annotations

import os
import sys

if __name__ == "__main__":
    os.setpgid(0, 0)
    os.execv(sys.argv[1], sys.argv[1:])  # noqa: S606 - no shell is what is wanted
