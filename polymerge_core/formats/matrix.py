"""Transforms from files: a 4x4 matrix as JSON."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from polymerge_core.errors import InputError
from polymerge_core.formats.strict_json import number_array, parse_json
from polymerge_core.formats.text import read_text


def read_matrix(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read a 4x4 matrix, written in JSON as four lists of four numbers.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    ndarray of float, shape (4, 4)
        Row by row as in the file.

    Raises
    ------
    InputError
        If the file is not strict JSON or holds something else.
    """
    where = os.fspath(path)
    matrix = number_array(parse_json(read_text(path), where), where)
    if matrix.shape != (4, 4):
        raise InputError(
            f"{where}: a 4x4 matrix is needed, four lists of four numbers, not one of shape {matrix.shape}"
        )
    return matrix
