"""Arrays of other libraries as NumPy arrays."""

import numpy as np


def as_numpy(value):
    """A NumPy array of what `numpy.asarray` takes, or of what has DLPack alone, in the host's memory."""
    if hasattr(value, "__dlpack__") and not hasattr(value, "__array__"):
        return np.from_dlpack(value)
    return np.asarray(value)
