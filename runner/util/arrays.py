"""Types of arrays that many modules handle."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Scalar = TypeVar("Scalar", bound=np.generic)
"""The element type of an array, for functions that keep it."""
Array = NDArray[np.generic]
"""An array whose element type is known only at run time, such as a column of a recording."""
Records = NDArray[np.void]
"""Structured records, such as messages of one topic."""
MaskedArray = np.ma.MaskedArray[tuple[int, ...], np.dtype[np.generic]]
"""An `Array` with missing values."""
Ints = NDArray[np.int64]
