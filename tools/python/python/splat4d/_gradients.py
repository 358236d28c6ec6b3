"""The gradients of a step with the caller's loss."""

from collections.abc import Mapping


class Gradients(Mapping):
    """The gradients of a step by name, float32; `Trainer.backward` lists names and shapes.

    Each array is copied from the device when it is read first. Those that have not been read when the step ends
    are copied then if the mapping still exists. Nothing is copied for a result of `Trainer.backward` that is not
    kept.
    """

    def __init__(self, source):
        self._source = source
        self._names = source.names()

    def __getitem__(self, name):
        if name not in self._names:
            raise KeyError(name)
        return self._source.read(name)

    def __contains__(self, name):
        return name in self._names

    def __iter__(self):
        return iter(self._names)

    def __len__(self):
        return len(self._names)

    def __repr__(self):
        return f"Gradients({', '.join(self._names)})"
